// The object's surface at a threshold (surface nets), and the shadow that it casts in a view (P · X).
const volumes = {}; // name → { codes, shape: [nz, ny, nx], origin, voxel, mesh }

// Pieces under 5 % of the largest, or of fewer than 27 voxels, are noise: as the measured surface has it.
function body(codes, shape, threshold) {
  const [nz, ny, nx] = shape, n = codes.length;
  const label = new Int32Array(n), queue = new Int32Array(n), sizes = [0];
  for (let start = 0; start < n; start++) {
    if (codes[start] >= threshold || label[start]) continue;
    const id = sizes.length;
    let head = 0, tail = 0;
    queue[tail++] = start;
    label[start] = id;
    while (head < tail) {
      const at = queue[head++], x = at % nx, y = ((at / nx) | 0) % ny, z = (at / (nx * ny)) | 0;
      for (let dz = z ? -1 : 0; dz <= (z < nz - 1 ? 1 : 0); dz++)
        for (let dy = y ? -1 : 0; dy <= (y < ny - 1 ? 1 : 0); dy++)
          for (let dx = x ? -1 : 0; dx <= (x < nx - 1 ? 1 : 0); dx++) {
            const to = at + (dz * ny + dy) * nx + dx;
            if (!label[to] && codes[to] < threshold) { label[to] = id; queue[tail++] = to; }
          }
    }
    sizes.push(tail);
  }
  const largest = Math.max(...sizes);
  const kept = sizes.map((s) => s >= 0.05 * largest && largest >= 27 && s > 0);
  const inside = new Uint8Array(n);
  for (let i = 0; i < n; i++) inside[i] = kept[label[i]] ? 1 : 0;
  return inside;
}

export function surface({ codes, shape, origin, voxel }, threshold) {
  const [nz, ny, nx] = shape, inside = body(codes, shape, threshold);
  // One voxel of padding mirrors the border, so that the surface closes half a voxel beyond its centres.
  const px = nx + 2, py = ny + 2, pz = nz + 2, field = new Float32Array(px * py * pz);
  const clamp = (v, top) => Math.min(Math.max(v, 0), top);
  for (let z = 0; z < pz; z++)
    for (let y = 0; y < py; y++)
      for (let x = 0; x < px; x++) {
        const cx = clamp(x - 1, nx - 1), cy = clamp(y - 1, ny - 1), cz = clamp(z - 1, nz - 1);
        const at = (cz * ny + cy) * nx + cx, out = cx !== x - 1 || cy !== y - 1 || cz !== z - 1;
        const depth = Math.min(Math.abs(threshold - codes[at]) || 0.5, threshold);
        field[(z * py + y) * px + x] = inside[at] && !out ? depth : -depth;
      }
  const cell = new Int32Array(px * py * pz).fill(-1), points = [], faces = [], sy = px, sz = px * py;
  const corner = [0, 1, sy, sy + 1, sz, sz + 1, sz + sy, sz + sy + 1];
  const edges = [];
  for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) edges.push([a, a | bit]);
  for (let z = 0; z < pz - 1; z++)
    for (let y = 0; y < py - 1; y++)
      for (let x = 0; x < px - 1; x++) {
        const at = z * sz + y * sy + x;
        let mask = 0;
        for (let i = 0; i < 8; i++) if (field[at + corner[i]] > 0) mask |= 1 << i;
        if (mask === 0 || mask === 255) continue;
        let n = 0, ux = 0, uy = 0, uz = 0;
        for (const [a, b] of edges) {
          const fa = field[at + corner[a]], fb = field[at + corner[b]];
          if (fa > 0 === fb > 0) continue;
          const t = fa / (fa - fb);
          ux += (a & 1) + t * ((b & 1) - (a & 1));
          uy += ((a >> 1) & 1) + t * (((b >> 1) & 1) - ((a >> 1) & 1));
          uz += (a >> 2) + t * ((b >> 2) - (a >> 2));
          n++;
        }
        cell[at] = points.length / 3;
        points.push(origin[0] + (x + ux / n - 1) * voxel, origin[1] + (y + uy / n - 1) * voxel, origin[2] + (z + uz / n - 1) * voxel);
      }
  const quad = (a, b, c, d, flip) => faces.push(...(flip ? [a, c, b, a, d, c] : [a, b, c, a, c, d]));
  for (let z = 0; z < pz - 1; z++)
    for (let y = 0; y < py - 1; y++)
      for (let x = 0; x < px - 1; x++) {
        const at = z * sz + y * sy + x, f = field[at] > 0;
        if (y && z && f !== field[at + 1] > 0) quad(cell[at - sy - sz], cell[at - sz], cell[at], cell[at - sy], !f);
        if (x && z && f !== field[at + sy] > 0) quad(cell[at - 1 - sz], cell[at - 1], cell[at], cell[at - sz], !f);
        if (x && y && f !== field[at + sz] > 0) quad(cell[at - 1 - sy], cell[at - sy], cell[at], cell[at - 1], !f);
      }
  return { points: new Float32Array(points), faces: new Uint32Array(faces) };
}

// The outline of the union of the triangles' shadows, as segments between pixels.
export function cast({ points, faces }, P, rows, cols) {
  const n = points.length / 3, uv = new Float32Array(2 * n);
  let u0 = cols, u1 = 0, v0 = rows, v1 = 0;
  for (let i = 0; i < n; i++) {
    const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
    const w = P[8] * x + P[9] * y + P[10] * z + P[11];
    const u = (P[0] * x + P[1] * y + P[2] * z + P[3]) / w, v = (P[4] * x + P[5] * y + P[6] * z + P[7]) / w;
    uv[2 * i] = u; uv[2 * i + 1] = v;
    u0 = Math.min(u0, u); u1 = Math.max(u1, u); v0 = Math.min(v0, v); v1 = Math.max(v1, v);
  }
  u0 = Math.max(0, Math.floor(u0) - 1); v0 = Math.max(0, Math.floor(v0) - 1);
  const w = Math.min(cols, Math.ceil(u1) + 2) - u0, h = Math.min(rows, Math.ceil(v1) + 2) - v0;
  if (w < 2 || h < 2) return new Float32Array(0);
  const dark = new Uint8Array(w * h);
  for (let i = 0; i < faces.length; i += 3) {
    const [a, b, c] = [2 * faces[i], 2 * faces[i + 1], 2 * faces[i + 2]];
    const ax = uv[a] - u0, ay = uv[a + 1] - v0, bx = uv[b] - u0, by = uv[b + 1] - v0, cx = uv[c] - u0, cy = uv[c + 1] - v0;
    const first = Math.max(0, Math.ceil(Math.min(ay, by, cy))), last = Math.min(h - 1, Math.floor(Math.max(ay, by, cy)));
    for (let y = first; y <= last; y++) {
      let left = 1e9, right = -1e9;
      for (const [px, py, qx, qy] of [[ax, ay, bx, by], [bx, by, cx, cy], [cx, cy, ax, ay]]) {
        if (Math.min(py, qy) > y || Math.max(py, qy) < y) continue;
        const x = py === qy ? px : px + ((y - py) / (qy - py)) * (qx - px);
        left = Math.min(left, x, py === qy ? qx : x); right = Math.max(right, x, py === qy ? qx : x);
      }
      for (let x = Math.max(0, Math.ceil(left - 0.5)); x <= Math.min(w - 1, right + 0.5); x++) dark[y * w + x] = 1;
    }
  }
  const lines = [];
  for (let y = 0; y < h; y++)
    for (let x = 0; x < w; x++) {
      const d = dark[y * w + x];
      if (d !== (x + 1 < w ? dark[y * w + x + 1] : 0)) lines.push(u0 + x + 0.5, v0 + y - 0.5, u0 + x + 0.5, v0 + y + 0.5);
      if (d !== (y + 1 < h ? dark[(y + 1) * w + x] : 0)) lines.push(u0 + x - 0.5, v0 + y + 0.5, u0 + x + 0.5, v0 + y + 0.5);
    }
  return new Float32Array(lines);
}

// A picture of levels, or a part (x, y, width, height) of it, as its bytes: the page looks them up where the screen wants them, which costs a third of
// having the browser draw them and reading that back.
async function decode({ id, blob, part }) {
  try {
    const { width, height, codes } = await ((self.ImageDecoder && (await decoded(blob, part))) || drawn(blob, part));
    self.postMessage({ id, width, height, codes, part }, [codes.buffer]);
  } catch {
    self.postMessage({ id });
  }
}

// Grey has its level in each of three bytes, whatever their order.
const levels = (pixels) => {
  const all = new Uint32Array(pixels), codes = new Uint8Array(all.length);
  for (let i = 0; i < all.length; i++) codes[i] = all[i];
  return codes;
};

// By the browser's decoder alone, which takes half as long: it is there on this machine, and over https.
let spare;
async function decoded(blob, part) {
  const decoder = new ImageDecoder({ data: await blob.arrayBuffer(), type: blob.type });
  try {
    const { image } = await decoder.decode();
    try {
      const { visibleRect } = image, [x, y, width, height] = part ?? [visibleRect.x, visibleRect.y, visibleRect.width, visibleRect.height];
      const of = { rect: { x, y, width, height } }, bytes = image.allocationSize(of);
      if (!/^(RGB|BGR)[AX]$/.test(image.format)) return undefined;
      const pixels = spare?.byteLength === bytes ? spare : new ArrayBuffer(bytes); // of this picture alone, until it is done
      spare = undefined;
      const [{ offset, stride }] = await image.copyTo(pixels, of);
      if (offset || stride !== 4 * width || bytes !== stride * height) return undefined;
      const codes = levels(pixels);
      spare = pixels;
      return { width, height, codes };
    } finally { image.close(); }
  } finally { decoder.close(); }
}

let canvas, context;
async function drawn(blob, part) {
  const bitmap = await (part ? createImageBitmap(blob, ...part) : createImageBitmap(blob)), { width, height } = bitmap;
  if (canvas?.width !== width || canvas.height !== height) {
    canvas = new OffscreenCanvas(width, height);
    context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
  }
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return { width, height, codes: levels(context.getImageData(0, 0, width, height).data.buffer) };
}

self.onmessage = ({ data }) => {
  if (data.do === "decode") return void decode(data);
  if (data.do === "volume") volumes[data.name] = { ...data.volume, codes: new Uint8Array(data.bytes) };
  if (data.do === "drop") delete volumes[data.name];
  const volume = volumes[data.name];
  if (!volume) {
    if (data.do === "surface") self.postMessage({ did: "surface", name: data.name }); // dropped meanwhile
    return;
  }
  if (data.do === "surface") {
    const began = performance.now();
    volume.mesh = surface(volume, data.threshold);
    const { points, faces } = volume.mesh;
    self.postMessage({ did: "surface", name: data.name, threshold: data.threshold, asked: data.asked, took: performance.now() - began, points: points.slice(), faces: faces.slice() });
  } else if (data.do === "cast" && volume.mesh) {
    self.postMessage({ did: "cast", key: data.key, lines: cast(volume.mesh, data.P, data.rows, data.cols) });
  }
};
