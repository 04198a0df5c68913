// Holds every message of a recording that has one of Foxglove's schemas against Foxglove's own JSON schema of it.
// node check_foxglove.mjs RUN.mcap; as read_mcap.mjs, and @foxglove/schemas and ajv. Prints, by topic, [messages, why the first bad one is].
import { opened, require, valueOf } from "./opened.mjs";

const schemas = require("@foxglove/schemas/jsonschema");
const ajv = new (require("ajv").default)({ strict: false });
const [file, reader] = await opened(process.argv[2]);

// As the JSON schemas write it: bytes in base64, times as sec and nsec.
function plain(value) {
  if (value instanceof Uint8Array) return Buffer.from(value).toString("base64");
  if (Array.isArray(value)) return value.map(plain);
  if (value === null || typeof value !== "object") return value;
  if ("nanos" in value) return { sec: value.seconds, nsec: value.nanos };
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, plain(item)]));
}

const checks = new Map();
function checkOf(name) {
  if (!checks.has(name)) checks.set(name, ajv.compile(schemas[name]));
  return checks.get(name);
}

const out = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  if (!schema?.name.startsWith("foxglove.")) continue;
  const found = valueOf(message, channel, schema, { longs: Number, defaults: true, enums: Number });
  const value = channel.messageEncoding === "json" ? found : plain(found);
  const told = (out[channel.topic] ??= [0, ""]);
  told[0] += 1;
  const fits = checkOf(schema.name.slice("foxglove.".length));
  if (!fits(value) && told[1] === "") told[1] = ajv.errorsText(fits.errors);
}
await file.close();
console.log(JSON.stringify(out));
