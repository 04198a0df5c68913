// Holds every message of a recording that has one of Foxglove's schemas against Foxglove's own JSON schema of it.
// node check_foxglove.mjs RUN.mcap; as read_mcap.mjs, and @foxglove/schemas and ajv. Prints, by topic, [messages, why the first bad one is].
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

const require = createRequire(process.env.MCAP_MODULES ?? import.meta.url);
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const schemas = require("@foxglove/schemas/jsonschema");
const protobuf = require("protobufjs");
const { FileDescriptorSet } = require("protobufjs/ext/descriptor");
const ajv = new (require("ajv").default)({ strict: false });

const file = await open(process.argv[2], "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, Number(length), Number(offset));
    return buffer;
  },
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: await loadDecompressHandlers(),
});

// As the JSON schemas write it: bytes in base64, times as sec and nsec.
function plain(value) {
  if (value instanceof Uint8Array) return Buffer.from(value).toString("base64");
  if (Array.isArray(value)) return value.map(plain);
  if (value === null || typeof value !== "object") return value;
  if ("nanos" in value) return { sec: value.seconds, nsec: value.nanos };
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, plain(item)]));
}

const out = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  if (!schema?.name.startsWith("foxglove.")) continue;
  let value;
  if (channel.messageEncoding === "json") {
    value = JSON.parse(new TextDecoder().decode(message.data));
  } else {
    const type = protobuf.Root.fromDescriptor(FileDescriptorSet.decode(schema.data)).lookupType(schema.name);
    value = plain(type.toObject(type.decode(message.data), { longs: Number, defaults: true, enums: Number }));
  }
  const told = (out[channel.topic] ??= [0, ""]);
  told[0] += 1;
  const fits = ajv.compile(schemas[schema.name.slice("foxglove.".length)]);
  if (!fits(value) && told[1] === "") told[1] = ajv.errorsText(fits.errors);
}
await file.close();
console.log(JSON.stringify(out));
