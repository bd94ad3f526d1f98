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
];
const VIEWS = new Set(["sub_aperture", "shadow", "likelihood", "reduced"]);

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

export class Panel {
  constructor(place, app, layer, label) {
    this.app = app;
    this.layer = layer;
    this.chosen = app.linkedLayers; // by hand, or by a link: not by what there is
    place.innerHTML = `<div class="row"><label>${label} <select aria-label="Layer, ${label}"></select></label><span class="about"></span></div><div class="dial"><csas-slider label="Aspect, ${label} picture"></csas-slider><div class="note"></div></div>`;
    this.select = place.querySelector("select");
    this.slider = place.querySelector("csas-slider");
    this.about = place.querySelector(".about");
    this.note = place.querySelector(".note");
    this.select.append(...LAYERS.map(([value, text]) => new Option(text, value)));
    this.select.value = layer;
    this.select.onchange = () => this.choose(this.select.value);
    this.slider.addEventListener("aspect", (e) => app.setAspect(e.detail.aspect, e.detail.when));
    this.slider.addEventListener("resized", () => app.dirty());
    this.pointers();
  }

  choose(layer) {
    this.chosen = true;
    this.layer = this.select.value = layer;
    if (layer === "reduced") this.app.wantReduced();
    this.app.refetch();
    this.app.dirty();
  }

  get isView() { return VIEWS.has(this.layer); }
  get radius() { return this.slider.disc; }

  // Scene metres → canvas pixels, as (a, b, c, d, e, f) of x' = a x + c y + e, y' = b x + d y + f.
  ground(view) {
    const { state } = this.app, canvas = this.slider.picture, k = canvas.width / this.slider.side;
    const scale = (this.radius / this.app.sceneRadius) * state.zoom * k, half = canvas.width / 2;
    let c = [scale, 0], r = [0, -scale]; // along x: (1, 0), along y: (0, -1)
    if (state.orientation === "sonar" && view) {
      const t = view.aspect_deg * RAD;
      c = [scale * Math.sin(t), -scale * Math.cos(t)];
      r = [-scale * Math.cos(t), -scale * Math.sin(t)];
    }
    const [x, y] = state.centre;
    return [c[0], r[0], c[1], r[1], half - c[0] * x - c[1] * y, half - r[0] * x - r[1] * y];
  }

  toScene(e) {
    const [a, b, c, d, tx, ty] = this.ground(this.app.current), det = a * d - b * c;
    const box = this.slider.picture.getBoundingClientRect(), k = this.slider.picture.width / this.slider.side;
    const x = (e.clientX - box.left) * k - tx, y = (e.clientY - box.top) * k - ty;
    return [(d * x - c * y) / det, (a * y - b * x) / det];
  }

  pointers() {
    const { slider, app } = this, held = new Map();
    slider.addEventListener("pointerdown", (e) => {
      if (slider.onRing(e)) return;
      slider.setPointerCapture(e.pointerId);
      held.set(e.pointerId, e);
      if (app.state.ruling && held.size === 1) app.state.ruler = [this.toScene(e), this.toScene(e)];
      app.dirty();
    });
    slider.addEventListener("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      if (app.state.ruling && held.size === 1) app.state.ruler[1] = this.toScene(e);
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
      slider.addEventListener(end, (e) => { if (held.delete(e.pointerId)) app.save(); });
    slider.addEventListener("wheel", (e) => {
      if (slider.onRing(e)) return;
      e.preventDefault();
      app.zoomBy(Math.exp(-Math.sign(e.deltaY) * 0.18), this.toScene(e));
    }, { passive: false });
  }

  // The picture to draw: the wanted view, or the nearest that is decoded meanwhile.
  find() {
    const { app, layer } = this;
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
    return { about, view: about, wanted: quick, bitmap };
  }

  draw() {
    const { app, slider } = this, canvas = slider.picture, g = canvas.getContext("2d", { alpha: false });
    if (!slider.side) return;
    const found = this.find(), { about, bitmap, view } = found, k = canvas.width / slider.side, half = canvas.width / 2;
    this.found = found;
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.globalCompositeOperation = "source-over";
    const T = this.ground(view);
    const onto = (A) => {
      const [a, b, c, d, e, f] = inverse(A); // pixel → ground
      g.setTransform(
        T[0] * a + T[2] * d, T[1] * a + T[3] * d, T[0] * b + T[2] * e, T[1] * b + T[3] * e,
        T[0] * c + T[2] * f + T[4], T[1] * c + T[3] * f + T[5],
      );
    };
    if (bitmap?.codes) this.levels(g, bitmap, product(about.A, inverse(swapped(T))), this.radius * k);
    else {
      g.fillStyle = "#000";
      g.fillRect(0, 0, canvas.width, canvas.width);
      if (bitmap) {
        onto(about.A);
        g.drawImage(bitmap, -0.5, -0.5);
      }
    }
    if (view && app.state.contour) this.outline(g, onto, view);
    if (view && app.state.cast) this.castOf(g, onto, view);
    g.setTransform(1, 0, 0, 1, 0, 0);
    this.furniture(g, T, view, k, half);
    this.describe(found, view);
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
  levels(g, { codes, width, height }, [a, b, c, d, e, f], radius) {
    const side = g.canvas.width, half = side / 2, { grey } = this;
    if (this.screen?.width !== side) this.screen = new ImageData(side, side);
    const out = new Uint32Array(this.screen.data.buffer).fill(0xff000000);
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
    g.putImageData(this.screen, 0, 0);
  }

  outline(g, onto, view) {
    const { app } = this, mask = app.sameStamp("shadow_mask", view);
    const lines = mask && app.loader.lines(`api/contour/${mask.stamp}/${mask.rev}.json`);
    if (!lines) return;
    onto(mask.A);
    g.beginPath();
    for (const line of lines) {
      g.moveTo(line[0], line[1]);
      for (let i = 2; i < line.length; i += 2) g.lineTo(line[i], line[i + 1]);
      g.closePath();
    }
    this.stroke(g, "#ffb347", 1.6);
  }

  castOf(g, onto, view) {
    const lines = this.app.castLines(view);
    if (!lines) return;
    onto(view.A);
    g.beginPath();
    for (let i = 0; i < lines.length; i += 4) { g.moveTo(lines[i], lines[i + 1]); g.lineTo(lines[i + 2], lines[i + 3]); }
    this.stroke(g, "#4fd1e8", 1.6);
  }

  stroke(g, colour, width) {
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.lineWidth = width * Math.min(devicePixelRatio, 2);
    g.strokeStyle = colour;
    g.lineJoin = "round";
    g.stroke();
  }

  furniture(g, T, view, k, half) {
    const { app } = this, r = this.radius * k, scale = Math.hypot(T[0], T[1]);
    const at = ([x, y]) => [T[0] * x + T[2] * y + T[4], T[1] * x + T[3] * y + T[5]];
    g.font = `${12 * k}px system-ui, sans-serif`;
    g.textAlign = "center";
    const written = (text, x, y, colour) => {
      g.lineWidth = 3 * k; g.strokeStyle = "#000b"; g.strokeText(text, x, y);
      g.fillStyle = colour; g.fillText(text, x, y);
    };
    // Scale bar: the roundest length of about a quarter of the picture.
    const goal = (0.5 * r) / scale, ten = 10 ** Math.floor(Math.log10(goal));
    const length = [5, 2, 1].map((m) => m * ten).find((m) => m <= goal) ?? ten, bar = length * scale;
    g.strokeStyle = "#000b"; g.lineWidth = 5 * k;
    const line = (w, c) => { g.beginPath(); g.moveTo(half - bar / 2, half + 0.86 * r); g.lineTo(half + bar / 2, half + 0.86 * r); g.lineWidth = w * k; g.strokeStyle = c; g.stroke(); };
    line(5, "#000b"); line(2.5, "#fff");
    written(length < 1 ? `${Math.round(length * 100)} cm` : `${length} m`, half, half + 0.86 * r - 6 * k, "#fff");
    // North, and where the sonar is.
    const n = [T[2] / scale, T[3] / scale], nx = half - 0.62 * r, ny = half - 0.62 * r;
    g.beginPath(); g.moveTo(nx - 12 * k * n[0], ny - 12 * k * n[1]); g.lineTo(nx + 12 * k * n[0], ny + 12 * k * n[1]);
    g.lineWidth = 2 * k; g.strokeStyle = "#fff"; g.stroke();
    written("N", nx + 21 * k * n[0], ny + 21 * k * n[1] + 4 * k, "#fff");
    if (view) {
      const t = view.aspect_deg * RAD, d = [T[0] * Math.cos(t) + T[2] * Math.sin(t), T[1] * Math.cos(t) + T[3] * Math.sin(t)].map((v) => v / scale);
      const tip = [half + 0.97 * r * d[0], half + 0.97 * r * d[1]];
      g.beginPath(); g.moveTo(...tip);
      g.lineTo(tip[0] - 12 * k * d[0] + 5 * k * d[1], tip[1] - 12 * k * d[1] - 5 * k * d[0]);
      g.lineTo(tip[0] - 12 * k * d[0] - 5 * k * d[1], tip[1] - 12 * k * d[1] + 5 * k * d[0]);
      g.fillStyle = "#29d85a"; g.fill();
    }
    const ruler = app.state.ruler;
    if (ruler) {
      const [a, b] = ruler.map(at);
      for (const [w, c] of [[4, "#000b"], [2, "#ffb347"]]) {
        g.beginPath(); g.moveTo(...a); g.lineTo(...b); g.lineWidth = w * k; g.strokeStyle = c; g.stroke();
        for (const p of [a, b]) { g.beginPath(); g.arc(...p, 3.5 * k, 0, 7); g.stroke(); }
      }
    }
  }

  describe(found, view) {
    const { app } = this, name = this.layer;
    let text = "";
    if (!this.isView) text = found.about ? "all aspects" : "not there yet";
    else if (!found.about) text = name === "reduced" && app.scene.reduced === false ? "needs the full-circle image" : "no view yet";
    else text = `${found.about.aperture_deg.toFixed(1).replace(/\.0$/, "")}° wide`;
    if (this.about.textContent !== text) this.about.textContent = text;
    const note = this.isView && found.about ? `${view.aspect_deg.toFixed(1)}°${found.late ? " (nearest)" : found.exact ? "" : " ·"}` : "";
    if (this.note.textContent !== note) this.note.textContent = note;
    const views = app.views(this.isView && app.views(name).length ? name : app.guide);
    const shown = found.view ? views.findIndex((v) => v.stamp === found.view.stamp) : -1;
    // Hue by aspect, as the picture has it.
    const turn = app.state.orientation === "sonar" && view ? view.aspect_deg - 90 : 0;
    this.slider.wheel = name === "color_by_aspect" ? turn : undefined;
    this.slider.show(app.aspectsOf(views), app.stepOf(views), shown >= 0 ? shown : app.nearestOf(views));
  }
}
