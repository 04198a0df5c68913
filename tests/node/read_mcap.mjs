// Reads a recording with the reference reader in JavaScript and prints what it found as JSON.
// node read_mcap.mjs RUN.mcap; NODE_PATH or node_modules beside holds @mcap/core, @mcap/support, protobufjs.
import { opened, valueOf } from "./opened.mjs";

const [file, reader] = await opened(process.argv[2]);

const out = { profile: reader.header.profile, attachments: {}, metadata: {}, counts: {}, first: {} };
for await (const attachment of reader.readAttachments()) {
  out.attachments[attachment.name] = Buffer.from(attachment.data).toString("utf8");
}
for await (const metadata of reader.readMetadata()) {
  out.metadata[metadata.name] = Object.fromEntries(metadata.metadata);
}
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  const value = valueOf(message, channel, schema, { longs: Number, bytes: Array });
  out.counts[channel.topic] = (out.counts[channel.topic] ?? 0) + 1;
  if (channel.topic !== "/artefacts" && !channel.topic.startsWith("/images")) {
    out.first[channel.topic] ??= value;
  } else if (channel.topic === "/artefacts") {
    out.artefactBytes = (out.artefactBytes ?? 0) + value.data.length;
  }
}
await file.close();
console.log(JSON.stringify(out));
