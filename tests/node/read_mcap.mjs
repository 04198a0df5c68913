// Reads a recording with the reference reader in JavaScript and prints what it found as JSON.
// node read_mcap.mjs RUN.mcap; NODE_PATH or node_modules beside holds @mcap/core, @mcap/support, protobufjs.
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

const require = createRequire(process.env.MCAP_MODULES ?? import.meta.url);
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const protobuf = require("protobufjs");
const { FileDescriptorSet } = require("protobufjs/ext/descriptor");

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

const types = new Map();
function typeOf(schema) {
  if (!types.has(schema.id)) {
    const root = protobuf.Root.fromDescriptor(FileDescriptorSet.decode(schema.data));
    types.set(schema.id, root.lookupType(schema.name));
  }
  return types.get(schema.id);
}

const out = { profile: reader.header.profile, attachments: {}, metadata: {}, counts: {}, first: {} };
for await (const attachment of reader.readAttachments()) {
  out.attachments[attachment.name] = Buffer.from(attachment.data).toString("utf8");
}
for await (const metadata of reader.readMetadata()) {
  out.metadata[metadata.name] = Object.fromEntries(metadata.metadata);
}
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const type = channel.messageEncoding === "json" ? null : typeOf(reader.schemasById.get(channel.schemaId));
  const value = type
    ? type.toObject(type.decode(message.data), { longs: Number, bytes: Array })
    : JSON.parse(new TextDecoder().decode(message.data));
  out.counts[channel.topic] = (out.counts[channel.topic] ?? 0) + 1;
  if (channel.topic !== "/artefacts" && !channel.topic.startsWith("/images")) {
    out.first[channel.topic] ??= value;
  } else if (channel.topic === "/artefacts") {
    out.artefactBytes = (out.artefactBytes ?? 0) + value.data.length;
  }
}
await file.close();
console.log(JSON.stringify(out));
