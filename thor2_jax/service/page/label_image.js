// Label maps as PNG images of 16 bits, as the service reads them.

const CRCS = Uint32Array.from({ length: 256 }, (_, value) => {
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
  return value;
});

function crc(bytes) {
  let value = 0xffffffff;
  for (const byte of bytes) value = CRCS[(value ^ byte) & 255] ^ (value >>> 8);
  return value ^ 0xffffffff;
}

function chunk(type, content) {
  const made = new Uint8Array(12 + content.length);
  const view = new DataView(made.buffer);
  view.setUint32(0, content.length);
  made.set([...type].map((letter) => letter.charCodeAt(0)), 4);
  made.set(content, 8);
  view.setUint32(8 + content.length, crc(made.subarray(4, 8 + content.length)));
  return made;
}

async function deflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Return the PNG of labels from 0 to 65535, row by row. */
export async function labelImage(labels, width, height) {
  const header = new DataView(new ArrayBuffer(13));
  header.setUint32(0, width);
  header.setUint32(4, height);
  header.setUint8(8, 16); // bits; the colour type is 0, grey
  const rows = new DataView(new ArrayBuffer(height * (1 + 2 * width))); // Each row begins with its filter, 0.
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) rows.setUint16(y * (1 + 2 * width) + 1 + 2 * x, labels[y * width + x]);
  }
  const chunks = [
    chunk("IHDR", new Uint8Array(header.buffer)),
    chunk("IDAT", await deflate(rows.buffer)),
    chunk("IEND", new Uint8Array()),
  ];
  return new Blob([Uint8Array.of(0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a), ...chunks], { type: "image/png" });
}

/** Return the labels of a label map, row by row. */
export function decoded({ width, height, labels, lengths }) {
  const map = new Int32Array(width * height);
  let start = 0;
  labels.forEach((label, k) => map.fill(label, start, (start += lengths[k])));
  return map;
}
