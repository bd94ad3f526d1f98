// Compressed views in memory. Of each, the part that the circle shows is decoded: first round the cursor and
// where it is heading, then, while nobody turns it, of all the others that there is room for.
const ROOM_BYTES = 300e6, DECODES = 2, FETCHES = 4;
// Decoded to the byte that the levels take, or to the four of colours.
const bytesOf = ({ codes, width, height }) => codes?.length ?? 4 * width * height;
const covers = (bitmap, part) => !bitmap.part || (!!part && bitmap.part[0] <= part[0] && bitmap.part[1] <= part[1] && bitmap.part[0] + bitmap.part[2] >= part[0] + part[2] && bitmap.part[1] + bitmap.part[3] >= part[1] + part[3]);

const COLOURS = /\/(likelihood|color_by_aspect)\//;
const isView = (address) => address.startsWith("api/view/") && address.endsWith(".jpg");
const isOutline = (address) => address.startsWith("api/contour/");

export class Loader {
  // partOf: which part of a picture is shown, and with a margin round it; undefined: all of it.
  constructor(files, startWorker, changed, partOf) {
    this.files = files; // of a page that was saved: address → data URL
    this.changed = changed;
    this.partOf = partOf;
    this.decoders = Array.from({ length: DECODES }, startWorker);
    this.answers = new Map(); // number of a question → what to do with its pixels: one address may be asked twice
    this.asked = 0;
    for (const each of this.decoders) each.onmessage = ({ data }) => this.answers.get(data.id)(data);
    this.blobs = new Map(); // address → Blob
    this.bitmaps = new Map(); // address → { width, height, codes, part } or ImageBitmap (colours), least recently used first
    this.decoded = 0; // bytes of them
    this.room = ROOM_BYTES;
    this.busy = new Map(); // address → "fetch" | "decode"
    this.failed = new Map(); // address → when
    this.awaited = new Set(); // outlines that a picture was drawn without
    this.wanted = []; // addresses to decode, the most wanted first
    this.ahead = []; // addresses to decode while nothing is wanted, the nearest last
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

  covered(address) {
    const found = this.bitmaps.get(address);
    return !!found && covers(found, this.partOf(address)?.shown);
  }

  // A picture that covers what is shown of it.
  bitmap(address) { return this.covered(address) ? this.whatever(address) : undefined; }

  // The same, or what there is of it.
  whatever(address) {
    const found = this.bitmaps.get(address);
    if (found) {
      this.bitmaps.delete(address);
      this.bitmaps.set(address, found);
    }
    return found;
  }

  want(addresses, ahead) {
    this.wanted = addresses;
    this.ahead = ahead;
    this.pump();
  }

  fetchAll(addresses) {
    this.all = addresses;
    this.filling = true;
    const kept = new Set(addresses);
    for (const a of this.blobs.keys()) if (!kept.has(a) && !a.endsWith(".png")) this.blobs.delete(a);
    for (const a of this.bitmaps.keys()) if (isView(a) && !kept.has(a) && !this.wanted.includes(a)) this.forget(a);
    for (const a of this.outlines.keys()) if (!kept.has(a)) this.outlines.delete(a);
    this.pump();
  }

  running(kind) { return [...this.busy.values()].filter((k) => k === kind).length; }

  pump() {
    for (const a of this.wanted) {
      if (this.busy.has(a) || this.covered(a)) continue;
      if (this.blobs.has(a)) {
        if (this.running("decode") < DECODES) this.decode(a);
      } else if (!this.paused && this.running("fetch") < FETCHES) this.fetch(a);
    }
    while (!this.paused && this.all.length && this.running("fetch") < FETCHES - 1) {
      const a = this.all.shift();
      if (!this.blobs.has(a) && !this.outlines.has(a) && !this.busy.has(a)) this.fetch(a);
    }
    if (this.filling && this.filled) {
      this.filling = false;
      this.changed(); // the page may decode ahead now
    }
    while (this.ahead.length && this.running("decode") < DECODES) {
      const a = this.ahead.pop(), part = this.partOf(a)?.decoded;
      if (this.busy.has(a) || !this.blobs.has(a) || this.covered(a)) continue;
      const bytes = part ? part[2] * part[3] : 0;
      if (this.decoded + bytes > this.room) this.ahead = []; // none is thrown out for one that may never be seen
      else this.decode(a);
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

  get filled() { return !this.all.length && !this.running("fetch"); }

  // Levels as bytes, by a thread of their own; colours as the browser decodes them.
  async pixels(a) {
    const blob = this.blobs.get(a), part = this.partOf(a)?.decoded;
    if (COLOURS.test(a)) return Object.assign(await (part ? createImageBitmap(blob, ...part) : createImageBitmap(blob)), { part });
    const decoder = this.decoders.shift(); // no more are busy than there are
    this.decoders.push(decoder);
    const id = ++this.asked;
    const answer = await new Promise((done) => {
      this.answers.set(id, done);
      decoder.postMessage({ do: "decode", id, blob, part });
    });
    this.answers.delete(id);
    if (!answer.codes) throw new Error(`${a} is no picture`);
    return answer;
  }

  async decode(a) {
    this.busy.set(a, "decode");
    try {
      const made = await this.pixels(a);
      this.forget(a);
      this.bitmaps.set(a, made);
      this.decoded += bytesOf(made);
      for (const old of this.bitmaps.keys()) {
        if (this.decoded <= this.room || old === a) break;
        this.forget(old);
      }
      this.changed(a);
    } catch {
      this.blobs.delete(a);
    }
    this.busy.delete(a);
    this.pump();
  }

  forget(a) {
    const old = this.bitmaps.get(a);
    if (!old) return;
    this.bitmaps.delete(a);
    this.decoded -= bytesOf(old);
    old.close?.();
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
