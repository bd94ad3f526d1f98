// Compressed views in memory, few of them decoded: those round the cursor and where it is heading.
const DECODED = 24, DECODES = 2, FETCHES = 4;

const COLOURS = /\/(likelihood|color_by_aspect)\//;
const isOutline = (address) => address.startsWith("api/contour/");

export class Loader {
  constructor(files, startWorker, changed) {
    this.files = files; // of a page that was saved: address → data URL
    this.changed = changed;
    this.decoders = Array.from({ length: DECODES }, startWorker);
    this.answers = new Map(); // address → what to do with its pixels
    for (const each of this.decoders) each.onmessage = ({ data }) => this.answers.get(data.id)(data);
    this.blobs = new Map(); // address → Blob
    this.bitmaps = new Map(); // address → { width, height, codes } or ImageBitmap (colours), least recently used first
    this.busy = new Map(); // address → "fetch" | "decode"
    this.failed = new Map(); // address → when
    this.awaited = new Set(); // outlines that a picture was drawn without
    this.wanted = []; // addresses to decode, the most wanted first
    this.all = []; // addresses to fetch sometime, coarse to fine
    this.outlines = new Map(); // address → closed lines
  }

  async get(address) {
    if (this.files) {
      const found = this.files[address];
      if (!found) throw new Error(`${address} is not in this file`);
      const [head, data] = found.split(",");
      const raw = atob(data), bytes = new Uint8Array(raw.length);
      for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
      return new Blob([bytes], { type: head.slice(5, head.indexOf(";")) });
    }
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${address}: ${answer.status} ${await answer.text()}`);
    return answer.blob();
  }

  has(address) { return this.bitmaps.has(address); }

  bitmap(address) {
    const found = this.bitmaps.get(address);
    if (found) {
      this.bitmaps.delete(address);
      this.bitmaps.set(address, found);
    }
    return found;
  }

  want(addresses) {
    this.wanted = addresses;
    this.pump();
  }

  fetchAll(addresses) {
    this.all = addresses;
    const kept = new Set(addresses);
    for (const a of this.blobs.keys()) if (!kept.has(a) && !a.endsWith(".png")) this.blobs.delete(a);
    for (const a of this.outlines.keys()) if (!kept.has(a)) this.outlines.delete(a);
    this.pump();
  }

  running(kind) { return [...this.busy.values()].filter((k) => k === kind).length; }

  pump() {
    for (const a of this.wanted) {
      if (this.bitmaps.has(a) || this.busy.has(a)) continue;
      if (this.blobs.has(a)) {
        if (this.running("decode") < DECODES) this.decode(a);
      } else if (!this.paused && this.running("fetch") < FETCHES) this.fetch(a);
    }
    while (!this.paused && this.all.length && this.running("fetch") < FETCHES - 1) {
      const a = this.all.shift();
      if (!this.blobs.has(a) && !this.outlines.has(a) && !this.busy.has(a)) this.fetch(a);
    }
  }

  async fetch(a) {
    if (performance.now() - (this.failed.get(a) ?? -1e9) < 2000) return;
    this.busy.set(a, "fetch");
    try {
      const blob = await this.get(a);
      if (isOutline(a)) {
        this.outlines.set(a, JSON.parse(await blob.text()));
        if (this.awaited.delete(a)) this.changed();
      } else this.blobs.set(a, blob);
      if (a.endsWith(".png")) {
        // Exact pictures are large: a few are kept.
        const exact = [...this.blobs.keys()].filter((k) => k.endsWith(".png"));
        for (const old of exact.slice(0, -8)) this.blobs.delete(old);
      }
    } catch {
      this.failed.set(a, performance.now()); // the server is away: it is asked again
      setTimeout(() => this.pump(), 2100);
    }
    this.busy.delete(a);
    this.pump();
  }

  // Levels as bytes, by a thread of their own; colours as the browser decodes them.
  async pixels(a) {
    if (COLOURS.test(a)) return createImageBitmap(this.blobs.get(a));
    const decoder = this.decoders.shift(); // no more are busy than there are
    this.decoders.push(decoder);
    const answer = await new Promise((done) => {
      this.answers.set(a, done);
      decoder.postMessage({ do: "decode", id: a, blob: this.blobs.get(a) });
    });
    this.answers.delete(a);
    if (!answer.codes) throw new Error(`${a} is no picture`);
    return answer;
  }

  async decode(a) {
    this.busy.set(a, "decode");
    try {
      this.bitmaps.set(a, await this.pixels(a));
      while (this.bitmaps.size > 2 * DECODED) {
        const [old, bitmap] = this.bitmaps.entries().next().value;
        this.bitmaps.delete(old);
        bitmap.close?.();
      }
      this.changed();
    } catch {
      this.blobs.delete(a);
    }
    this.busy.delete(a);
    this.pump();
  }

  // A mask's outlines; undefined until they are there.
  lines(a) {
    if (!this.outlines.has(a)) {
      this.awaited.add(a);
      if (!this.busy.has(a) && !this.paused) this.fetch(a);
    }
    return this.outlines.get(a);
  }
}

export function coarseToFine(list) {
  const order = [], seen = new Set();
  for (let stride = 64; stride >= 1; stride >>= 1)
    for (let i = 0; i < list.length; i += stride) if (!seen.has(i)) { seen.add(i); order.push(list[i]); }
  return order;
}
