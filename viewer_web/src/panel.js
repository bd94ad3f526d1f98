// One picture in its circle: which layer, how it lies on the screen, and what is drawn over it.
import "./slider.js";

const RAD = Math.PI / 180;
export const LAYERS = [
  ["sub_aperture", "Sub-aperture"],
  ["shadow", "Shadow-enhanced"],
  ["likelihood", "Likelihood"],
  ["reduced", "Reduced aperture"],
  ["multilook", "Multi-look"],
  ["color_by_aspect", "Colour by aspect"],
  ["six_sub_aperture", "Six sub-apertures"],
  ["six_shadow", "Six shadow-enhanced"],
];
// Of a second run that is compared with: offered where there is one.
export const OTHER_LAYERS = [["b.sub_aperture", "B: sub-aperture"], ["b.shadow", "B: shadow-enhanced"], ["b.likelihood", "B: likelihood"]];
const VIEWS = new Set(["sub_aperture", "shadow", "likelihood", "reduced", ...OTHER_LAYERS.map(([name]) => name)]);
// Of figures 3 and 6 of the paper.
const SIX_DEG = [0, 60, 120, 180, 240, 300];
export const isOther = (layer) => layer.startsWith("b.");
export const COLOURS = { outline: "#ffb347", cast: "#4fd1e8", ruler: "#ffe14d", pick: "#ff7ad9", sonar: "#29d85a" };

export function inverse(A) {
  const [a, b, c, d, e, f] = A, det = a * e - b * d;
  return [e / det, -b / det, (b * f - c * e) / det, -d / det, a / det, (c * d - a * f) / det];
}

// The canvas counts its six numbers by columns, the views by rows.
const swapped = ([a, b, c, d, e, f]) => [a, c, e, b, d, f];
const product = ([a, b, c, d, e, f], [p, q, r, s, t, u]) => [a * p + b * s, a * q + b * t, a * r + b * u + c, d * p + e * s, d * q + e * t, d * r + e * u + f];

// Whole steps n from start, by step, that stay within 0 … end (end left out: its next pixel must be there).
function within(start, step, end) {
  if (!step) return start >= 0 && start < end ? [0, Infinity] : [1, 0];
  const one = -start / step, other = (end - 1 - start) / step;
  return [Math.ceil(Math.min(one, other)), Math.floor(Math.max(one, other))];
}

// CSS pixels.
const OUTLINE_PX = 1.6;
const [OUTLINE_R, OUTLINE_G, OUTLINE_B] = [1, 3, 5].map((i) => parseInt(COLOURS.outline.slice(i, i + 2), 16));

// A closed line into pixels, before they go to the canvas: its own strokes take several times as long, and
// cost a seventh of the views that are drawn in a second. M: the line's pixels → the canvas's.
function trace(out, side, radius, line, [a, b, c, d, e, f], width) {
  const reach = width / 2 + 0.5, n = line.length, half = side / 2;
  let px = a * line[n - 2] + b * line[n - 1] + c, py = d * line[n - 2] + e * line[n - 1] + f;
  for (let i = 0; i < n; i += 2) {
    const x = a * line[i] + b * line[i + 1] + c, y = d * line[i] + e * line[i + 1] + f;
    const dx = x - px, dy = y - py, square = dx * dx + dy * dy || 1, flat = Math.abs(dx) >= Math.abs(dy);
    const mx = (x + px) / 2 - half, my = (y + py) / 2 - half, most = radius + reach + Math.sqrt(square) / 2;
    if (mx * mx + my * my > most * most) { // nothing of it is on the disc
      px = x;
      py = y;
      continue;
    }
    // Along the longer of its sides, and as far to both of the other as the line is wide.
    const p = flat ? px : py, q = flat ? py : px, along = flat ? dx : dy, across = flat ? dy : dx, slope = along ? across / along : 0;
    const off = reach * Math.sqrt(1 + slope * slope), low = Math.min(q, q + across), high = Math.max(q, q + across);
    const last = Math.min(side - 1, Math.floor(Math.max(p, p + along) + reach));
    for (let s = Math.max(0, Math.floor(Math.min(p, p + along) - reach)); s <= last; s++) {
      const middle = Math.min(high, Math.max(low, q + (s + 0.5 - p) * slope)), end = Math.min(side - 1, Math.floor(middle + off));
      for (let t = Math.max(0, Math.floor(middle - off)); t <= end; t++) {
        const h = flat ? s : t, v = flat ? t : s, fx = h + 0.5 - px, fy = v + 0.5 - py;
        const share = Math.min(1, Math.max(0, (fx * dx + fy * dy) / square)), ex = fx - share * dx, ey = fy - share * dy;
        const cover = Math.min(256, (256 * (reach - Math.sqrt(ex * ex + ey * ey))) | 0);
        if (cover <= 0) continue;
        const at = v * side + h, old = out[at], red = old & 255, green = (old >> 8) & 255, blue = (old >> 16) & 255;
        out[at] = 0xff000000 | (red + (((OUTLINE_R - red) * cover) >> 8)) | ((green + (((OUTLINE_G - green) * cover) >> 8)) << 8) | ((blue + (((OUTLINE_B - blue) * cover) >> 8)) << 16);
      }
    }
    px = x;
    py = y;
  }
}

export class Panel {
  constructor(place, app, layer, label) {
    this.app = app;
    this.layer = layer;
    this.chosen = app.linkedLayers; // by hand, or by a link: not by what there is
    place.innerHTML = `<div class="row"><label>${label} <select aria-label="Layer, ${label}"></select></label><span class="about"></span></div><div class="dial"><csas-slider label="Aspect, ${label} picture"></csas-slider><div class="note"></div><div class="empty" role="status"></div></div><div class="scale"><span class="low"></span><canvas class="bar" width="255" height="1" role="img" aria-label="Levels from black to white"></canvas><span class="high"></span><span class="told"></span></div>`;
    this.select = place.querySelector("select");
    this.slider = place.querySelector("csas-slider");
    this.about = place.querySelector(".about");
    this.note = place.querySelector(".note");
    this.empty = place.querySelector(".empty");
    [this.low, this.bar, this.high, this.told] = [".low", ".bar", ".high", ".told"].map((c) => place.querySelector(c));
    this.slider.takesTouch = (touch) => app.state.ruling || !!this.endAt(touch);
    this.select.append(...LAYERS.map(([value, text]) => new Option(text, value)));
    this.select.value = layer;
    this.select.onchange = () => this.choose(this.select.value);
    this.slider.addEventListener("aspect", (e) => app.setAspect(e.detail.aspect, e.detail.when, true));
    // A canvas that changes its size is empty: drawn at once, it is never seen so.
    this.slider.addEventListener("resized", () => { if (this.found) this.draw(); app.dirty(); });
    this.pointers();
  }

  offer(layers) {
    if (this.select.options.length === layers.length) return;
    this.select.replaceChildren(...layers.map(([value, text]) => new Option(text, value)));
    this.select.value = this.layer;
  }

  choose(layer) {
    if (![...this.select.options].some((o) => o.value === layer)) return;
    this.chosen = true;
    this.layer = this.select.value = layer;
    if (layer === "reduced") this.app.wantReduced();
    this.app.refetch();
    this.app.dirty();
  }

  get isView() { return VIEWS.has(this.layer); }
  get six() { return this.layer.startsWith("six_") ? this.layer.slice(4) : ""; }
  get radius() { return this.slider.disc; }
  // What is drawn on: side and radius in the canvas's pixels, k of them a CSS pixel.
  get frame() {
    const { picture, side } = this.slider, k = picture.width / (side || 1);
    return { canvas: picture, side: picture.width, radius: this.radius * k, k: k * this.slider.em };
  }

  // Degrees that the scene lies turned by, counter-clockwise: until true north is up, or the sonar.
  turn(view) { return this.app.state.orientation === "sonar" && view ? 90 - view.aspect_deg : -this.app.north; }

  // Scene metres → canvas pixels, as (a, b, c, d, e, f) of x' = a x + c y + e, y' = b x + d y + f.
  ground(view, frame = this.frame) {
    const { state } = this.app, scale = (frame.radius / this.app.sceneRadius) * state.zoom, half = frame.side / 2;
    const t = this.turn(view) * RAD, c = [scale * Math.cos(t), -scale * Math.sin(t)], r = [-scale * Math.sin(t), -scale * Math.cos(t)];
    const [x, y] = state.centre;
    return [c[0], r[0], c[1], r[1], half - c[0] * x - c[1] * y, half - r[0] * x - r[1] * y];
  }

  onCanvas([x, y], T = this.ground(this.app.current)) { return [T[0] * x + T[2] * y + T[4], T[1] * x + T[3] * y + T[5]]; }

  // Which end of a ruler is under a pointer: those of the view that is shown.
  endAt(e) {
    const box = this.slider.picture.getBoundingClientRect(), k = this.slider.picture.width / (this.slider.side || 1), T = this.ground(this.app.current);
    const reach = (e.pointerType === "mouse" ? 9 : 22) * k * this.slider.em;
    for (const ruler of this.app.rulersHere())
      for (const end of [1, 0]) {
        const [x, y] = this.onCanvas(ruler.ends[end], T);
        if (Math.hypot(x - (e.clientX - box.left) * k, y - (e.clientY - box.top) * k) < reach) return { ruler, end };
      }
  }

  toScene(e) {
    const [a, b, c, d, tx, ty] = this.ground(this.app.current), det = a * d - b * c;
    const box = this.slider.picture.getBoundingClientRect(), k = this.slider.picture.width / this.slider.side;
    const x = (e.clientX - box.left) * k - tx, y = (e.clientY - box.top) * k - ty;
    return [(d * x - c * y) / det, (a * y - b * x) / det];
  }

  pointers() {
    const { slider, app } = this, held = new Map();
    let pressed, grip;
    slider.addEventListener("pointerdown", (e) => {
      if (slider.onRing(e) || this.six) return;
      slider.setPointerCapture(e.pointerId);
      held.set(e.pointerId, e);
      pressed = held.size === 1 ? e : undefined;
      grip = held.size === 1 ? this.endAt(e) : undefined;
      if (grip) app.ruler = grip.ruler;
      else if (app.state.ruling && held.size === 1) grip = { ruler: app.newRuler(this.toScene(e), this.toScene(e)), end: 1 };
      app.dirty();
    });
    slider.addEventListener("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      if (pressed && Math.hypot(e.clientX - pressed.clientX, e.clientY - pressed.clientY) > 4) pressed = undefined;
      if (grip && held.size === 1) app.moveEnd(grip.ruler, grip.end, this.toScene(e));
      else {
        if (held.size === 2) {
          const other = [...held.values()].find((h) => h.pointerId !== e.pointerId);
          const far = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
          app.zoomBy(far(e) / Math.max(1, far(before)), this.toScene(other));
        } else {
          const [x0, y0] = this.toScene(before), [x1, y1] = this.toScene(e);
          app.moveBy(x0 - x1, y0 - y1);
        }
      }
      held.set(e.pointerId, e);
      app.dirty();
    });
    for (const end of ["pointerup", "pointercancel"])
      slider.addEventListener(end, (e) => {
        if (!held.delete(e.pointerId)) return;
        if (grip) app.ruled(grip.ruler);
        else if (pressed && end === "pointerup") app.pickGround(this.toScene(e));
        grip = pressed = undefined;
        app.save();
      });
    slider.addEventListener("wheel", (e) => {
      if (slider.onRing(e)) return;
      e.preventDefault();
      app.zoomBy(Math.exp(-Math.sign(e.deltaY) * 0.18), this.toScene(e));
    }, { passive: false });
  }

  // The picture to draw: the wanted view, or the nearest that is decoded meanwhile.
  find() {
    const { app, layer } = this;
    if (this.six) return { view: app.current, bitmap: app.views(this.six).length ? true : undefined, exact: true, about: {} };
    if (!this.isView) {
      const about = app.scene.pictures[layer];
      const address = about && `api/picture/${layer}/${about.rev}.png`;
      return { about, view: app.current, wanted: address, bitmap: address && app.loader.bitmap(address), exact: true };
    }
    const views = app.views(layer), at = app.nearest(layer);
    const about = views[at];
    if (!about) return { view: app.current };
    const exact = app.address(layer, about, "png"), quick = app.address(layer, about, "jpg");
    let bitmap = app.loader.bitmap(exact);
    if (bitmap) return { about, view: about, wanted: quick, bitmap, exact: true };
    bitmap = app.loader.bitmap(quick);
    for (let off = 1; !bitmap && off <= 12; off++)
      for (const side of [-1, 1]) {
        const other = views[(at + side * off + views.length) % views.length];
        const found = other && app.loader.bitmap(app.address(layer, other, "jpg"));
        if (found) return { about: other, view: other, wanted: quick, bitmap: found, late: true };
      }
    // Of a picture that was just zoomed out of, or moved: what there is of it, until the rest is decoded.
    const part = bitmap ? undefined : app.loader.whatever(quick);
    return { about, view: about, wanted: quick, bitmap: bitmap ?? part, partly: !!part };
  }

  draw() {
    if (!this.slider.side) return;
    this.found = this.find();
    if (this.slider.onPaper) this.print(this.frame);
    else this.paint(this.frame);
    this.describe(this.found, this.found.view);
  }

  // A browser prints what is drawn on a canvas as lines and images, and none of the pixels that were put there;
  // a circle that was cleared in the middle covers the picture with white. So both come as one image.
  print(frame) {
    const one = new OffscreenCanvas(frame.side, frame.side), { slider } = this;
    this.paint({ ...frame, canvas: one });
    if (!this.six) one.getContext("2d").drawImage(slider.ring, 0, 0);
    slider.picture.getContext("2d", { alpha: false }).drawImage(one, 0, 0);
  }

  paint(frame) {
    const g = frame.canvas.getContext("2d", { alpha: false });
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.globalCompositeOperation = "source-over";
    if (this.six) this.paintSix(g, frame);
    else this.paintOne(g, frame, this.found);
  }

  paintOne(g, frame, { about, bitmap, view }) {
    const { app } = this, T = this.ground(view, frame), other = isOther(this.layer) ? app.offset : [0, 0];
    // A second run's pictures are moved so that its contact lies where the first one's does.
    const onto = (A, [dx, dy] = [0, 0]) => {
      const [a, b, c, d, e, f] = inverse(A); // pixel → ground
      g.setTransform(
        T[0] * a + T[2] * d, T[1] * a + T[3] * d, T[0] * b + T[2] * e, T[1] * b + T[3] * e,
        T[0] * (c + dx) + T[2] * (f + dy) + T[4], T[1] * (c + dx) + T[3] * (f + dy) + T[5],
      );
    };
    const moved = [T[0], T[1], T[2], T[3], T[4] + T[0] * other[0] + T[2] * other[1], T[5] + T[1] * other[0] + T[3] * other[1]];
    const outline = view && app.state.contour && bitmap && this.outline(view, isOther(this.layer) ? "b." : "");
    if (bitmap?.codes) this.levels(g, bitmap, product(about.A, inverse(swapped(moved))), frame, outline && { ...outline, M: product(swapped(moved), inverse(outline.A)) });
    else {
      g.fillStyle = "#000";
      g.fillRect(0, 0, frame.side, frame.side);
      if (bitmap) {
        onto(about.A, other);
        g.drawImage(bitmap, (bitmap.part?.[0] ?? 0) - 0.5, (bitmap.part?.[1] ?? 0) - 0.5);
      }
      if (outline) {
        onto(outline.A, other);
        this.strokeOutline(g, outline.lines, frame.k);
      }
    }
    if (view && app.state.cast && !isOther(this.layer)) this.castOf(g, onto, view, frame.k);
    g.setTransform(1, 0, 0, 1, 0, 0);
    this.furniture(g, T, view, frame);
  }

  // Six views at once, every 60°: each as the large picture lies.
  paintSix(g, frame) {
    const { app } = this, set = this.six, views = app.views(set), { side, k } = frame;
    g.fillStyle = "#12181d";
    g.fillRect(0, 0, side, side);
    const cell = Math.floor(Math.min(side / 3, (side - 40 * k) / 2)), radius = cell / 2 - 3 * k, top = (side - 2 * cell) / 2 - 6 * k;
    const tile = (this.tile ??= new OffscreenCanvas(1, 1));
    tile.width = tile.height = cell;
    const tg = tile.getContext("2d", { alpha: false }), small = { canvas: tile, side: cell, radius, k };
    this.sixWanted = [];
    if (views.length) SIX_DEG.forEach((aspect, i) => {
      const view = views[app.nearestOf(views, aspect)], address = app.address(set, view, "jpg"), bitmap = app.loader.bitmap(address);
      this.sixWanted.push(address);
      const x = (i % 3) * cell, y = top + Math.floor(i / 3) * (cell + 14 * k);
      tg.setTransform(1, 0, 0, 1, 0, 0);
      tg.fillStyle = "#000";
      tg.fillRect(0, 0, cell, cell);
      const T = this.ground(view, small), outline = app.state.contour && this.outline(view, "");
      if (bitmap?.codes) this.levels(tg, bitmap, product(view.A, inverse(swapped(T))), small, outline && { ...outline, M: product(swapped(T), inverse(outline.A)) });
      g.save();
      g.beginPath();
      g.arc(x + cell / 2, y + cell / 2, radius, 0, 7);
      g.clip();
      g.drawImage(tile, x, y);
      g.restore();
      g.strokeStyle = "#8697a3"; g.lineWidth = k;
      g.beginPath(); g.arc(x + cell / 2, y + cell / 2, radius, 0, 7); g.stroke();
      g.font = `${11 * k}px system-ui, sans-serif`; g.textAlign = "center"; g.fillStyle = "#c9d3d9";
      g.fillText(`${view.aspect_deg.toFixed(0)}°`, x + cell / 2, y + cell + 9 * k);
      // Where the sonar is.
      const t = view.aspect_deg * RAD, s = Math.hypot(T[0], T[1]), d = [T[0] * Math.cos(t) + T[2] * Math.sin(t), T[1] * Math.cos(t) + T[3] * Math.sin(t)].map((v) => v / s);
      g.beginPath(); g.arc(x + cell / 2 + (radius - 6 * k) * d[0], y + cell / 2 + (radius - 6 * k) * d[1], 4 * k, 0, 7); g.fillStyle = COLOURS.sonar; g.fill();
    });
  }

  // Grey of each level: from lo to hi dB it goes from black to white.
  get grey() {
    const { low_db, step_db } = this.app.scene.codes, { top, range } = this.app.state;
    const code = (db) => Math.min(254, Math.max(1, (db - low_db) / step_db + 1));
    const hi = code(top), lo = code(top - range), name = `${lo} ${hi}`;
    if (this.table?.name !== name) {
      const grey = Uint32Array.from({ length: 256 }, (_, c) => {
        const v = Math.round(255 * Math.min(1, Math.max(0, (c - lo) / (hi - lo))));
        return 0xff000000 + v * 0x10101;
      });
      this.table = { name, grey };
    }
    return this.table.grey;
  }

  // Levels where the screen wants them, between their four neighbours, as greys. M: canvas → picture pixels.
  levels(g, { codes, width, height, part }, [a, b, left, d, e, top], { radius, k }, outline) {
    const c = left - (part?.[0] ?? 0), f = top - (part?.[1] ?? 0);
    const side = g.canvas.width, half = side / 2, { grey } = this;
    this.screens ??= new Map();
    if (this.screens.size > 3) this.screens.clear();
    if (!this.screens.has(side)) this.screens.set(side, new ImageData(side, side));
    const screen = this.screens.get(side), out = new Uint32Array(screen.data.buffer).fill(0xff000000);
    const first = Math.max(0, Math.floor(half - radius)), last = Math.min(side - 1, Math.ceil(half + radius));
    // In 1/65536 pixels: whole numbers are what makes this fast.
    const [a1, d1] = [a, d].map((n) => Math.round(n * 65536)), [right, below] = [(width - 1) * 65536, (height - 1) * 65536];
    for (let y = first; y <= last; y++) {
      const reach = Math.sqrt(Math.max(0, radius * radius - (y + 0.5 - half) ** 2)) + 1;
      const x0 = Math.max(0, Math.floor(half - reach)), x1 = Math.min(side - 1, Math.ceil(half + reach));
      const u0 = Math.round((a * (x0 + 0.5) + b * (y + 0.5) + c) * 65536), v0 = Math.round((d * (x0 + 0.5) + e * (y + 0.5) + f) * 65536);
      const [uFrom, uTo] = within(u0, a1, right), [vFrom, vTo] = within(v0, d1, below);
      const from = Math.max(0, uFrom, vFrom), to = Math.min(x1 - x0, uTo, vTo);
      if (from > to) continue;
      let u = u0 + a1 * from, v = v0 + d1 * from;
      for (let at = y * side + x0 + from, end = y * side + x0 + to; at <= end; at++, u = (u + a1) | 0, v = (v + d1) | 0) {
        const i = ((v >> 16) * width + (u >> 16)) | 0, p = (u >> 8) & 255, q = (v >> 8) & 255;
        const one = codes[i], two = codes[i + width];
        const upper = ((one << 8) + (codes[i + 1] - one) * p) | 0, lower = ((two << 8) + (codes[i + width + 1] - two) * p) | 0;
        out[at] = grey[((upper << 8) + (lower - upper) * q) >> 16];
      }
    }
    if (outline) for (const line of outline.lines) trace(out, side, radius, line, outline.M, OUTLINE_PX * k);
    g.putImageData(screen, 0, 0);
  }

  // A view's segmented shadow: closed lines (u0, v0, u1, v1, …) in pixels of its mask, and where those lie.
  outline(view, run) {
    const { app } = this, mask = app.sameStamp(`${run}shadow_mask`, view);
    const lines = mask && app.loader.lines(app.contourAddress(run, mask));
    return lines && { lines, A: mask.A };
  }

  strokeOutline(g, lines, k) {
    g.beginPath();
    for (const line of lines) {
      g.moveTo(line[0], line[1]);
      for (let i = 2; i < line.length; i += 2) g.lineTo(line[i], line[i + 1]);
      g.closePath();
    }
    this.stroke(g, COLOURS.outline, OUTLINE_PX * k);
  }

  castOf(g, onto, view, k) {
    const lines = this.app.castLines(view);
    if (!lines) return;
    onto(view.A);
    g.beginPath();
    for (let i = 0; i < lines.length; i += 4) { g.moveTo(lines[i], lines[i + 1]); g.lineTo(lines[i + 2], lines[i + 3]); }
    this.stroke(g, COLOURS.cast, 1.6 * k);
  }

  stroke(g, colour, width) {
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.lineWidth = width;
    g.strokeStyle = colour;
    // Corners as they come, the sharpest cut off: half the time of round ones.
    g.lineJoin = "miter";
    g.miterLimit = 2;
    g.stroke();
  }

  furniture(g, T, view, { side, radius: r, k }) {
    const { app } = this, half = side / 2, scale = Math.hypot(T[0], T[1]);
    const at = ([x, y]) => [T[0] * x + T[2] * y + T[4], T[1] * x + T[3] * y + T[5]];
    g.font = `${12 * k}px system-ui, sans-serif`;
    g.textAlign = "center";
    const written = (text, x, y, colour) => {
      g.lineWidth = 3 * k; g.strokeStyle = "#000b"; g.strokeText(text, x, y);
      g.fillStyle = colour; g.fillText(text, x, y);
    };
    if (!view) return; // nothing says how large anything is
    // Scale bar: the roundest length of about a quarter of the picture.
    const goal = (0.5 * r) / scale, ten = 10 ** Math.floor(Math.log10(goal));
    const length = [5, 2, 1].map((m) => m * ten).find((m) => m <= goal) ?? ten, bar = length * scale;
    g.strokeStyle = "#000b"; g.lineWidth = 5 * k;
    const line = (w, c) => { g.beginPath(); g.moveTo(half - bar / 2, half + 0.86 * r); g.lineTo(half + bar / 2, half + 0.86 * r); g.lineWidth = w * k; g.strokeStyle = c; g.stroke(); };
    line(5, "#000b"); line(2.5, "#fff");
    written(length < 1 ? `${Math.round(length * 100)} cm` : `${length} m`, half, half + 0.86 * r - 6 * k, "#fff");
    // North, and where the sonar is.
    const tn = (90 + app.north) * RAD, n = [0, 1].map((i) => (T[i] * Math.cos(tn) + T[i + 2] * Math.sin(tn)) / scale), nx = half - 0.62 * r, ny = half - 0.62 * r;
    g.beginPath(); g.moveTo(nx - 12 * k * n[0], ny - 12 * k * n[1]); g.lineTo(nx + 12 * k * n[0], ny + 12 * k * n[1]);
    g.lineWidth = 2 * k; g.strokeStyle = "#fff"; g.stroke();
    written("N", nx + 21 * k * n[0], ny + 21 * k * n[1] + 4 * k, "#fff");
    {
      const t = view.aspect_deg * RAD, d = [T[0] * Math.cos(t) + T[2] * Math.sin(t), T[1] * Math.cos(t) + T[3] * Math.sin(t)].map((v) => v / scale);
      const tip = [half + 0.97 * r * d[0], half + 0.97 * r * d[1]];
      g.beginPath(); g.moveTo(...tip);
      g.lineTo(tip[0] - 12 * k * d[0] + 5 * k * d[1], tip[1] - 12 * k * d[1] - 5 * k * d[0]);
      g.lineTo(tip[0] - 12 * k * d[0] - 5 * k * d[1], tip[1] - 12 * k * d[1] + 5 * k * d[0]);
      g.fillStyle = "#29d85a"; g.fill();
    }
    // Contacts, by their numbers: a second run's are others.
    for (const c of isOther(this.layer) ? [] : app.scene.contacts ?? []) {
      const [x, y] = at(c.position_m), chosen = c.id === app.contact?.id;
      if (Math.hypot(x - half, y - half) > r || app.scene.contacts.length < 2) continue;
      const d = 5 * k;
      g.lineWidth = (chosen ? 2 : 1) * k; g.strokeStyle = chosen ? COLOURS.sonar : "#dfe7ec";
      g.beginPath(); g.moveTo(x - d, y); g.lineTo(x + d, y); g.moveTo(x, y - d); g.lineTo(x, y + d); g.stroke();
      // Beside its cross, as far as the disc has room for it.
      const name = c.name.replace("Contact ", ""), wide = g.measureText(name).width / 2 + 3 * k, chord = Math.sqrt(r * r - Math.min(r, Math.abs(y - 12 * k - half)) ** 2);
      written(name, Math.max(half - chord + wide, Math.min(half + chord - wide, x + 9 * k)), y - 6 * k, chosen ? COLOURS.sonar : "#dfe7ec");
    }
    for (const ruler of app.rulersHere()) {
      const [a, b] = ruler.ends.map(at), told = app.measured(ruler);
      for (const [w, c] of [[4, "#000b"], [ruler === app.ruler ? 2.4 : 1.4, told.height === undefined ? "#c9d3d9" : COLOURS.ruler]]) {
        g.setLineDash(told.height === undefined ? [5 * k, 4 * k] : []);
        g.beginPath(); g.moveTo(...a); g.lineTo(...b); g.lineWidth = w * k; g.strokeStyle = c; g.stroke();
        g.setLineDash([]);
        for (const p of [a, b]) { g.beginPath(); g.arc(...p, 4.5 * k, 0, 7); g.stroke(); }
      }
      written(told.height === undefined ? `${told.distance.toFixed(2)} m` : `h ${told.height.toFixed(2)} m`, b[0], b[1] + 18 * k, COLOURS.ruler);
    }
    const pick = app.pickedGround(view);
    if (pick) {
      const [x, y] = at(pick), d = 8 * k;
      for (const [w, c] of [[4, "#000b"], [2, COLOURS.pick]]) {
        g.lineWidth = w * k; g.strokeStyle = c;
        g.beginPath(); g.moveTo(x - d, y - d); g.lineTo(x + d, y + d); g.moveTo(x - d, y + d); g.lineTo(x + d, y - d); g.stroke();
      }
    }
  }

  // The grey bar under the picture, in dB over the view's median, or what the colours mean.
  scale() {
    const { top, range } = this.app.state, name = this.layer;
    const kind = name.endsWith("likelihood") ? "likelihood" : name === "color_by_aspect" ? "hue" : "level", key = `${kind} ${top} ${range}`;
    if (this.scaled === key) return;
    this.scaled = key;
    const g = this.bar.getContext("2d");
    for (let i = 0; i < 255; i++) {
      g.fillStyle = kind === "hue" ? `hsl(${(360 * i) / 255} 100% 50%)` : `rgb(${i},${i},${i})`;
      g.fillRect(i, 0, 1, 1);
    }
    [this.low.textContent, this.high.textContent, this.told.textContent] = {
      level: [`${top - range} dB`, `${top > 0 ? "+" : ""}${top} dB`, "over the view's median"],
      likelihood: ["shadow 0", "1 none", "blue: unknown"],
      hue: ["aspect 0°", "360°", "grey: from all sides"],
    }[kind];
  }

  describe(found, view) {
    const { app } = this, name = this.layer;
    let text = "";
    if (this.six) text = "every 60°";
    else if (!this.isView) text = found.about ? "all aspects" : "not there yet";
    else if (!found.about) text = name === "reduced" && app.scene.reduced === false ? "needs the full-circle image" : "no view yet";
    else text = `${found.about.aperture_deg.toFixed(1).replace(/\.0$/, "")}° wide`;
    if (this.about.textContent !== text) this.about.textContent = text;
    const note = this.isView && found.about ? `${view.aspect_deg.toFixed(1)}°${found.late ? " (nearest)" : found.exact ? "" : " ·"}` : "";
    if (this.note.textContent !== note) this.note.textContent = note;
    const empty = found.bitmap ? "" : app.awaited(this);
    if (this.empty.textContent !== empty) this.empty.textContent = empty;
    this.scale();
    const views = app.views(this.isView && app.views(name).length ? name : app.guide);
    const shown = found.view ? views.findIndex((v) => v.stamp === found.view.stamp) : -1;
    // Hue by aspect, as the picture has it.
    const turn = this.turn(view);
    this.slider.wheel = name === "color_by_aspect" ? -turn : undefined;
    if (this.slider.bare !== !!this.six) {
      this.slider.bare = !!this.six;
      for (const part of [this.slider.ring, this.slider.dot]) part.style.visibility = this.six ? "hidden" : "visible";
    }
    this.slider.turns = app.state.orientation === "sonar";
    const rings = !this.six && !isOther(name);
    this.slider.turn = turn;
    this.slider.north = app.north;
    this.slider.evidence = rings ? app.evidence : undefined;
    this.slider.show(app.aspectsOf(views), app.stepOf(views), shown >= 0 ? shown : app.nearestOf(views));
  }
}
