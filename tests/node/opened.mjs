// A recording opened by the reference reader, and its messages as plain values; for the scripts beside.
// NODE_PATH, MCAP_MODULES or node_modules beside holds @mcap/core, @mcap/support, protobufjs.
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

export const require = createRequire(process.env.MCAP_MODULES ?? import.meta.url);
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const protobuf = require("protobufjs");
const { FileDescriptorSet } = require("protobufjs/ext/descriptor");

export async function opened(path) {
  const file = await open(path, "r");
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      await file.read(buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const decompressHandlers = await loadDecompressHandlers();
  return [file, await McapIndexedReader.Initialize({ readable, decompressHandlers })];
}

const types = new Map();
function typeOf(schema) {
  if (!types.has(schema.id)) {
    const root = protobuf.Root.fromDescriptor(FileDescriptorSet.decode(schema.data));
    types.set(schema.id, root.lookupType(schema.name));
  }
  return types.get(schema.id);
}

export function valueOf(message, channel, schema, options) {
  if (channel.messageEncoding === "json") return JSON.parse(new TextDecoder().decode(message.data));
  const type = typeOf(schema);
  return type.toObject(type.decode(message.data), options);
}
