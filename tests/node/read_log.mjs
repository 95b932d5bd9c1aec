// Reads logs by index and as a stream, CRCs checked, and prints what it found as JSON: one entry a file.
// Usage: node read_log.mjs FILE...

import { createHash } from "node:crypto";
import { open, readFile } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";

const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };

class Tally {
  topics = {};
  digest = createHash("sha256");

  add(topic, message) {
    this.topics[topic] = (this.topics[topic] ?? 0) + 1;
    this.digest.update(`${topic} ${message.logTime} ${message.sequence} `).update(message.data);
    if (typeof JSON.parse(new TextDecoder().decode(message.data)).t !== "number") {
      throw new Error(`${topic}: a message without a number t`);
    }
  }

  result() {
    return { topics: this.topics, sha256: this.digest.digest("hex") };
  }
}

async function indexed(path) {
  const file = await open(path);
  try {
    const readable = {
      size: async () => BigInt((await file.stat()).size),
      read: async (offset, size) => {
        const buffer = new Uint8Array(Number(size));
        await file.read(buffer, 0, Number(size), Number(offset));
        return buffer;
      },
    };
    const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
    const tally = new Tally();
    const found = [];
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      found.push(message);
    }
    // The index yields messages by time; the stream as written. Compare them in one order.
    const name = (message) => reader.channelsById.get(message.channelId).topic;
    found.sort((a, b) => name(a).localeCompare(name(b)) || a.sequence - b.sequence);
    found.forEach((message) => tally.add(name(message), message));
    const attachments = [];
    for await (const attachment of reader.readAttachments({ validateCrcs: true })) {
      attachments.push(attachment.name);
    }
    const metadata = [];
    for await (const record of reader.readMetadata()) {
      metadata.push(record.name);
    }
    return { ...tally.result(), count: Number(reader.statistics.messageCount), attachments, metadata };
  } finally {
    await file.close();
  }
}

async function streamed(path) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(await readFile(path));
  const channels = new Map();
  const found = [];
  const attachments = [];
  const metadata = [];
  const schemas = new Map();
  for (let record; (record = reader.nextRecord()) !== undefined; ) {
    if (record.type === "Channel") channels.set(record.id, record);
    if (record.type === "Schema") schemas.set(record.id, record);
    if (record.type === "Message") found.push([channels.get(record.channelId).topic, record]);
    if (record.type === "Attachment") attachments.push(record.name);
    if (record.type === "Metadata") metadata.push(record.name);
  }
  if (!reader.done()) throw new Error(`${path}: the stream has no end`);
  for (const channel of channels.values()) {
    JSON.parse(new TextDecoder().decode(schemas.get(channel.schemaId).data));
  }
  const tally = new Tally();
  found.sort(([a, x], [b, y]) => a.localeCompare(b) || x.sequence - y.sequence);
  found.forEach(([topic, message]) => tally.add(topic, message));
  return { ...tally.result(), count: found.length, attachments, metadata };
}

const report = {};
for (const path of process.argv.slice(2)) {
  report[path] = { indexed: await indexed(path), streamed: await streamed(path) };
}
console.log(JSON.stringify(report));
