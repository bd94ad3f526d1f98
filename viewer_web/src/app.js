import { coarseToFine, Loader } from "./loader.js";
import { inverse, LAYERS, Panel } from "./panel.js";
import { Solid } from "./solid.js";

const $ = (id) => document.getElementById(id);
const DEFAULTS = { aspect: 0, layers: ["sub_aperture", "shadow"], zoom: 1, centre: [0, 0], orientation: "north", top: 18, range: 38, contour: true, cast: false, compare: false, evidence: false, thresholds: {} };
const REST_MS = 160;

class App {
  constructor() {
    const held = $("content");
    const content = held && JSON.parse(held.textContent);
    const linked = this.fromLink();
    this.linkedLayers = !!linked.layers;
    this.state = { ...structuredClone(DEFAULTS), ...linked, ruling: false, ruler: null };
    this.scene = { sets: {}, pictures: {}, volumes: {}, track: [], target: null, dimensions: null, codes: { low_db: -32, step_db: 0.25 } };
    this.sorted = {};
    this.volumes = {};
    this.casts = new Map();
    this.stats = { drawn: 0, events: [], latency: [], surfaces: [], first: 0 };
    const startWorker = () => new Worker(this.workerAddress(content?.files));
    this.loader = new Loader(content?.files, startWorker, () => this.dirty());
    this.panels = [new Panel($("panel-a"), this, this.state.layers[0], "Left"), new Panel($("panel-b"), this, this.state.layers[1], "Right")];
    this.startSurfaces(startWorker());
    // The first picture goes before the first object.
    setTimeout(() => this.startSolid(), 1500);
    this.controls();
    if (content) {
      $("link").textContent = "saved file";
      $("save-html").hidden = $("save-mesh-row").hidden = true; // the server makes these
      this.all(content.scene);
    } else this.connect();
  }

  startSolid() {
    if (this.solid) return;
    this.solid = new Solid($("gl"), $("stage-note"), this);
    for (const name of ["track", "target", "volumes"]) this.part(name);
  }

  // The run, as the server tells it

  connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
    socket.onmessage = (e) => this.notice(JSON.parse(e.data));
    socket.onopen = () => { this.tries = 0; this.linked(true); };
    socket.onclose = () => {
      this.linked(false);
      this.tries = (this.tries ?? 0) + 1;
      setTimeout(() => this.connect(), Math.min(2000, 200 * this.tries));
    };
  }

  linked(on) {
    $("link").textContent = on ? (this.scene.live ? "live" : "connected") : "viewer is away: waiting for it";
    $("link").classList.toggle("on", on);
    this.loader.paused = !on;
  }

  notice(n) {
    if (n.type === "all") this.all(n.scene);
    else if (n.type === "view") {
      const set = this.scene.sets[n.set], at = set.views.findIndex((v) => v.stamp === n.view.stamp);
      if (at >= 0) set.views[at] = n.view; else set.views.push(n.view);
      delete this.sorted[n.set];
      this.later();
    } else if (n.type === "part") {
      this.scene[n.part] = n.value;
      this.part(n.part);
      this.dirty();
    }
  }

  later() {
    this.timer ??= setTimeout(() => { this.timer = undefined; this.refetch(); this.dirty(); }, 60);
  }

  all(scene) {
    if (this.scene.live && scene.live && scene.instance !== this.scene.instance) this.keep(scene);
    const target = JSON.stringify(this.scene.target);
    this.scene = scene;
    if (JSON.stringify(scene.target) !== target) this.looked = false;
    this.settleLayers();
    this.sorted = {};
    document.title = `${scene.title || "CSAS"} — shadows`;
    $("title").textContent = scene.title || "CSAS shadows";
    if ($("link").classList.contains("on")) this.linked(true);
    for (const name of ["track", "target", "volumes", "dimensions", "pictures", "damage", "reduced"]) this.part(name);
    this.refetch();
    this.dirty();
  }

  // A viewer that was restarted in mid-run gets the views it missed at the run's end: until then the page
  // goes on showing those that it has itself.
  keep(scene) {
    for (const [name, set] of Object.entries(this.scene.sets)) {
      const there = new Set(scene.sets[name]?.views.map((v) => v.stamp));
      const same = scene.sets[name]?.views.some((v) => set.views.some((o) => o.stamp === v.stamp)) || !there.size;
      if (!same) continue;
      for (const v of set.views) if (!there.has(v.stamp) && this.loader.blobs.has(this.address(name, v, "jpg"))) scene.sets[name].views.push({ ...v, kept: true });
    }
  }

  part(name) {
    if (name === "track" || name === "target") {
      this.solid?.surroundings();
      if (this.solid && name === "target" && this.scene.target && !this.looked) { this.looked = true; this.solid.whole(false); }
    } else if (name === "volumes" && this.solid) {
      for (const each of ["main", "other"]) if (this.scene.volumes[each]) this.fetchVolume(each); else this.dropVolume(each);
    } else if (name === "damage") {
      $("damage").hidden = !this.scene.damage;
      $("damage").textContent = $("damage").title = this.scene.damage ?? "";
    } else if (name === "reduced") {
      if (this.scene.reduced && this.panels.some((p) => p.layer === "reduced")) this.wantReduced();
    } else if (name === "dimensions" || name === "truth") this.dimensions();
    if (name === "track" || name === "pictures") this.refetch();
  }

  // Pictures that nobody chose by hand show what there is.
  settleLayers() {
    const there = LAYERS.map(([name]) => name).filter((name) => this.scene.sets[name]?.views.length);
    if (!there.length) return;
    this.panels.forEach((p, i) => { if (!p.chosen && !there.includes(p.layer)) p.layer = p.select.value = there[Math.min(i, there.length - 1)]; });
  }

  views(name) {
    return (this.sorted[name] ??= [...(this.scene.sets[name]?.views ?? [])].sort((a, b) => a.aspect_deg - b.aspect_deg));
  }

  aspectsOf(views) { return (views.aspects ??= views.map((v) => v.aspect_deg)); }

  stepOf(views) {
    if (views.step === undefined) {
      const gaps = views.map((v, i) => (i ? v.aspect_deg - views[i - 1].aspect_deg : 360)).sort((a, b) => a - b);
      views.step = Math.min(10, gaps[gaps.length >> 2] ?? 1);
    }
    return views.step;
  }

  get guide() { return ["shadow", "sub_aperture", "likelihood", "shadow_mask"].find((n) => this.views(n).length) ?? "shadow"; }

  nearestOf(views) {
    let best = -1, least = 1e9;
    views.forEach((v, i) => {
      const off = Math.abs(((v.aspect_deg - this.state.aspect + 540) % 360) - 180);
      if (off < least) [least, best] = [off, i];
    });
    return best;
  }

  nearest(name) { return this.nearestOf(this.views(name)); }
  get current() { const views = this.views(this.guide); return views[this.nearestOf(views)]; }
  sameStamp(name, view) {
    const views = this.views(name);
    views.byStamp ??= new Map(views.map((v) => [v.stamp, v]));
    return views.byStamp.get(view.stamp);
  }
  address(name, view, kind) { return `api/view/${name}/${view.stamp}/${view.rev}.${kind}`; }

  get sceneRadius() {
    const view = this.current;
    if (!view) return 1;
    const [a, b, , d, e] = inverse(view.A);
    return 0.5 * Math.min(view.cols * Math.hypot(a, d), view.rows * Math.hypot(b, e)) * 0.72;
  }

  // What to fetch and decode

  refetch() {
    const lists = this.panels.filter((p) => p.isView).map((p) => this.views(p.layer).map((v) => this.address(p.layer, v, "jpg")));
    const order = lists.map(coarseToFine), mixed = [];
    for (let i = 0; i < Math.max(0, ...order.map((l) => l.length)); i++) for (const l of order) if (l[i]) mixed.push(l[i]);
    this.loader.fetchAll([...new Set(mixed)]);
  }

  prefetch() {
    const wanted = [], ahead = Math.sign(this.velocity || 1), rest = !this.scrubbing() && !this.playing;
    for (const p of this.panels) {
      if (p.found?.wanted) wanted.push(p.found.wanted);
      if (rest && p.isView && p.found?.about && !p.found.about.kept && !this.loader.files) wanted.push(this.address(p.layer, p.found.about, "png"));
    }
    for (let i = 1; i <= 6; i++)
      for (const p of this.panels) {
        if (!p.isView) continue;
        const views = this.views(p.layer), at = this.nearest(p.layer);
        for (const side of i <= 2 ? [ahead, -ahead] : [ahead]) {
          const v = views[(at + side * i + views.length * 8) % views.length];
          if (v) wanted.push(this.address(p.layer, v, "jpg"));
        }
      }
    this.loader.want([...new Set(wanted)]);
  }

  async wantReduced() {
    if (this.loader.files || this.asked) return;
    this.asked = true;
    try { await fetch("api/reduced"); } finally { this.asked = false; }
  }

  // State

  setAspect(aspect, when = performance.now()) {
    const turn = ((aspect - this.state.aspect + 540) % 360) - 180;
    this.velocity = turn;
    this.state.aspect = aspect;
    for (const p of this.panels) p.slider.aspect = aspect;
    this.moved = performance.now();
    this.stats.pending = when;
    clearTimeout(this.rest);
    this.rest = setTimeout(() => { this.dirty(); this.save(); }, REST_MS + 20);
    this.dirty();
  }

  scrubbing() { return performance.now() - (this.moved ?? -1e9) < REST_MS; }

  zoomBy(by, [x, y] = this.state.centre) {
    const zoom = Math.min(40, Math.max(0.5, this.state.zoom * by)), f = 1 - this.state.zoom / zoom;
    this.state.centre = [this.state.centre[0] + f * (x - this.state.centre[0]), this.state.centre[1] + f * (y - this.state.centre[1])];
    this.state.zoom = zoom;
    this.save();
    this.dirty();
  }

  moveBy(x, y) {
    this.state.centre = [this.state.centre[0] + x, this.state.centre[1] + y];
    this.dirty();
  }

  save() {
    clearTimeout(this.saving);
    this.saving = setTimeout(() => history.replaceState(null, "", this.link()), 200);
  }

  link() {
    const s = this.state, kept = { ...s, layers: this.panels.map((p) => p.layer) };
    delete kept.ruling;
    return `#${encodeURIComponent(JSON.stringify(kept, (_, v) => (typeof v === "number" ? +v.toFixed(4) : v)))}`;
  }

  fromLink() {
    let told = {};
    try { told = JSON.parse(decodeURIComponent(location.hash.slice(1))); } catch { /* no link of ours */ }
    // Whoever shortens or edits a link gets the default for what is not understood.
    const like = (a, b) => typeof a === typeof b && (typeof a !== "number" || Number.isFinite(a)) && (!Array.isArray(b) || (Array.isArray(a) && a.length === b.length && a.every((v, i) => like(v, b[i]))));
    const kept = Object.fromEntries(Object.entries(told ?? {}).filter(([key, value]) => value !== null && key in DEFAULTS && like(value, DEFAULTS[key])));
    if (kept.layers) kept.layers = kept.layers.map((name, i) => (LAYERS.some(([each]) => each === name) ? name : DEFAULTS.layers[i]));
    return kept;
  }

  // Drawing

  dirty() {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => { this.frame = 0; this.draw(); });
  }

  draw() {
    for (const p of this.panels) p.draw();
    this.prefetch();
    const view = this.current;
    this.solid?.sonar(view);
    if (view) {
      const bearing = (450 - view.aspect_deg) % 360, t = new Date(Number(BigInt(view.stamp) / 1000000n)).toISOString().slice(0, 23).replace("T", " ");
      $("where").textContent = `aspect ${view.aspect_deg.toFixed(1)}° · sonar bears ${bearing.toFixed(1).padStart(5, "0")}° · ${t}Z`;
    }
    if (this.state.ruler) $("measured").textContent = this.measured();
    const shown = this.panels.map((p) => p.found?.about?.stamp ?? "").join();
    const all = this.panels.every((p) => p.found?.bitmap), late = this.panels.some((p) => p.found?.late);
    if (all && !this.stats.first) { this.stats.first = performance.now(); setTimeout(() => this.startSolid(), 50); }
    if (shown !== this.stats.shown && all) { this.stats.drawn++; this.stats.shown = shown; }
    if (this.stats.pending !== undefined && all && !late) {
      this.stats.latency.push(performance.now() - this.stats.pending);
      if (this.stats.latency.length > 5000) this.stats.latency.shift();
      this.stats.pending = undefined;
    }
  }

  measured() {
    const [a, b] = this.state.ruler, view = this.current, d = Math.hypot(b[0] - a[0], b[1] - a[1]);
    if (!view) return `${d.toFixed(3)} m`;
    const [sx, sy, sz] = view.sonar, ra = Math.hypot(a[0] - sx, a[1] - sy), rb = Math.hypot(b[0] - sx, b[1] - sy);
    const psi = Math.atan2(sz, rb), L = rb - ra, h = L * Math.tan(psi);
    return `${d.toFixed(2)} m; shadow L = ${L.toFixed(2)} m → h = L · tan ψ = ${L.toFixed(2)} m × tan ${((psi * 180) / Math.PI).toFixed(1)}° = ${h.toFixed(2)} m (ψ: grazing angle at the shadow's tip)`;
  }

  // The object

  workerAddress(files) {
    const address = "static/worker.js";
    if (!files) return address;
    return (this.madeWorker ??= URL.createObjectURL(new Blob([atob(files[address].split(",")[1])], { type: "text/javascript" })));
  }

  startSurfaces(worker) {
    this.worker = worker;
    this.worker.onmessage = ({ data }) => {
      if (data.did === "surface" && !this.volumes[data.name]) this.busySurface = false; // of a run that is gone
      else if (data.did === "surface") {
        this.stats.surfaces.push(performance.now() - data.asked);
        this.busySurface = false;
        this.solid.set(data.name, data);
        $(`row-${data.name}`).dataset.triangles = data.faces.length / 3;
        if (data.name === "main") this.casts.clear();
        if (this.nextSurface) { const next = this.nextSurface; this.nextSurface = undefined; this.surface(...next); }
      } else {
        this.casts.set(data.key, data.lines);
        if (this.casts.size > 400) this.casts.delete(this.casts.keys().next().value);
      }
      this.dirty();
    };
  }

  async fetchVolume(name) {
    const about = this.scene.volumes[name];
    if (this.volumes[name]?.rev === about.rev) return;
    try {
      const bytes = await (await this.loader.get(`api/volume/${name}/${about.rev}.bin`)).arrayBuffer();
      if (this.scene.volumes[name]?.rev !== about.rev) return;
      const codes = new Uint8Array(bytes);
      this.volumes[name] = { ...about, codes };
      this.worker.postMessage({ do: "volume", name, volume: { shape: about.shape, origin: about.origin, voxel: about.voxel }, bytes: codes.buffer.slice(0) });
      $(`row-${name}`).hidden = false;
      const row = $(`row-${name}`), label = { soft: "Soft carving", hard: "Hard carving", consensus: "Silhouettes" }[about.method] ?? about.method;
      row.querySelector("span").textContent = label;
      $(`tag-${name}`).textContent = label;
      const input = $(`threshold-${name}`);
      input.max = about.method === "soft" ? 254 : 160;
      const auto = about.threshold === null ? 1 : Math.max(1, 254 * Math.sqrt(about.threshold));
      this.auto = { ...this.auto, [name]: auto };
      const chosen = this.state.thresholds[about.method] ?? auto; // a threshold of another method means nothing
      input.value = chosen;
      this.threshold(name, chosen);
    } catch { /* a newer volume has come, or the server is away: it is told again */ }
  }

  dropVolume(name) {
    $(`row-${name}`).hidden = true;
    if (!this.volumes[name]) return;
    delete this.volumes[name];
    this.worker.postMessage({ do: "drop", name });
    this.solid.set(name, { points: new Float32Array(0), faces: new Uint32Array(0) });
    this.solid.evidence(name, { codes: new Uint8Array(0), shape: [0, 0, 0], origin: [0, 0, 0], voxel: 1 }, 1);
    delete $(`row-${name}`).dataset.triangles;
    $(`tag-${name}`).textContent = "";
    if (name !== "main") return;
    clearTimeout(this.exact);
    this.casts.clear();
    this.surfaceMeasures = this.thresholdQuery = undefined;
    this.dimensions();
  }

  threshold(name, code) {
    const value = (code / 254) ** 2, row = $(`row-${name}`);
    row.querySelector("output").textContent = value < 0.1 ? value.toFixed(4) : value.toFixed(3);
    this.surface(name, code, performance.now());
    if (this.state.evidence && this.volumes[name]) this.solid.evidence(name, this.volumes[name], Math.min(254, code * 1.25));
    if (name !== "main" || this.loader.files) return;
    clearTimeout(this.exact);
    this.exact = setTimeout(() => this.measureAt(value), 300);
  }

  surface(name, code, asked) {
    // Only the newest threshold is worked on after the one under way.
    if (this.busySurface) {
      if (this.nextSurface && this.nextSurface[0] !== name) setTimeout(() => this.surface(name, code, asked), 30);
      else this.nextSurface = [name, code, asked];
      return;
    }
    this.busySurface = true;
    this.worker.postMessage({ do: "surface", name, threshold: code, asked });
  }

  async measureAt(value) {
    const auto = this.scene.volumes.main?.threshold;
    const at = auto && Math.abs(value - auto) < 2e-4 ? "" : `?threshold=${value}`;
    this.thresholdQuery = at;
    try { this.surfaceMeasures = await (await fetch(`api/surface/main.json${at}`)).json(); } catch { this.surfaceMeasures = undefined; }
    if (!this.volumes.main) this.surfaceMeasures = undefined;
    this.dimensions();
  }

  castLines(view) {
    const key = view.stamp + view.rev;
    if (!this.casts.has(key)) {
      this.casts.set(key, null);
      this.worker.postMessage({ do: "cast", name: "main", key, P: view.P, rows: view.rows, cols: view.cols });
    }
    return this.casts.get(key);
  }

  dimensions() {
    const d = this.scene.dimensions, t = this.scene.truth, m = this.surfaceMeasures, table = $("dimensions");
    table.replaceChildren();
    const row = (cells, tag = "td") => {
      const tr = table.insertRow();
      for (const text of cells) tr.append(Object.assign(document.createElement(tag), { textContent: text }));
    };
    row(["", "found, 95 %", ...(t ? ["truth"] : []), ...(m?.object ? ["surface here"] : [])], "th");
    const names = [["length_m", "Length", "m"], ["width_m", "Width", "m"], ["height_m", "Height", "m"], ["volume_m3", "Volume", "m³"]];
    for (const [key, label, unit] of names) {
      const v = d?.[key], i = d?.intervals?.[key], digits = unit === "m" ? 2 : 3;
      if (v === undefined && !m?.object) continue;
      const found = v === undefined || v === null ? "—" : `${v.toFixed(digits)}${i ? ` ± ${((i[1] - i[0]) / 2).toFixed(digits)}` : ""} ${unit}`;
      row([label, found, ...(t ? [t[key] === undefined ? "" : `${t[key].toFixed(digits)} ${unit}`] : []), ...(m?.object ? [`${m[key].toFixed(digits)} ${unit}`] : [])]);
    }
    if (d?.heading_rad !== undefined) {
      const i = d.intervals?.heading_rad, deg = 180 / Math.PI;
      row(["Heading", `${(d.heading_rad * deg).toFixed(1)}${i ? ` ± ${(((i[1] - i[0]) / 2) * deg).toFixed(1)}` : ""} °`]);
    }
    if (m && !m.object) row(["", "no object at this threshold"]);
    if (!d && !m) row(["", this.scene.status || "nothing carved yet"]);
  }

  // Controls

  controls() {
    const s = this.state, press = (id, work) => ($(id).onclick = work);
    const check = (id, work) => { $(id).checked = s[id]; $(id).onchange = () => { s[id] = $(id).checked; work?.(); this.save(); this.dirty(); this.solid?.dirty(); }; };
    check("contour");
    check("cast");
    check("compare", () => ($("tag-other").hidden = !s.compare));
    check("evidence", () => { if (s.evidence) for (const n of Object.keys(this.volumes)) this.threshold(n, +$(`threshold-${n}`).value); });
    $("tag-other").hidden = !s.compare;
    $("whole").onchange = () => this.solid?.whole($("whole").checked);
    press("play", () => this.play());
    press("orientation", () => this.turn());
    press("ruler", () => this.rule());
    press("fit", () => this.fit());
    press("help-open", () => $("help").showModal());
    press("save-picture", () => this.savePicture());
    press("copy-link", () => this.copyLink());
    press("save-html", () => this.download("api/export.html?step=2"));
    $("save-mesh").onchange = () => { const kind = $("save-mesh").value; if (kind && this.surfaceMeasures && !this.surfaceMeasures.object) $("measured").textContent = "No object at this threshold: no mesh to save."; else if (kind) this.download(`api/mesh/main.${kind}${this.thresholdQuery ?? ""}`); $("save-mesh").value = ""; };
    for (const [id, key] of [["top-db", "top"], ["range-db", "range"]]) {
      const input = $(id);
      input.oninput = () => { s[key] = +input.value; this.sayLevels(); this.save(); this.dirty(); };
    }
    this.sayLevels();
    for (const name of ["main", "other"]) $(`threshold-${name}`).oninput = (e) => { s.thresholds[this.volumes[name]?.method ?? name] = +e.target.value; this.threshold(name, +e.target.value); this.save(); };
    $("orientation").textContent = s.orientation === "north" ? "North up" : "Sonar up";
    addEventListener("keydown", (e) => this.key(e));
    // What was clicked would take the keys: a space would press it again instead of playing.
    addEventListener("click", (e) => {
      if (!e.detail) return; // by a key
      const pressed = e.target.closest?.("button, input[type=checkbox], label");
      (pressed?.querySelector("input[type=checkbox]") ?? pressed)?.blur();
    });
    addEventListener("hashchange", () => location.reload());
  }

  // No code is darker than the lowest: a range beyond it would be a lie.
  sayLevels() {
    const s = this.state, low = this.scene.codes.low_db;
    s.range = Math.min(s.range, s.top - low);
    for (const [id, key] of [["top-db", "top"], ["range-db", "range"]]) {
      $(id).value = s[key];
      $(id).nextElementSibling.textContent = `${s[key]} dB`;
    }
  }

  // A step on the screen (right, up; of the picture's radius at no zoom), in scene metres.
  onScreen([right, up], share) {
    const [a, b, c, d] = this.panels[1].ground(this.current), det = a * d - b * c, x = (d * right + c * up) / det, y = (-a * up - b * right) / det;
    const m = (share * this.sceneRadius) / this.state.zoom / Math.hypot(x, y);
    return [x * m, y * m];
  }

  key(e) {
    if ($("help").open || e.ctrlKey || e.metaKey) return;
    const typing = e.target.matches?.("input:not([type=checkbox]), select");
    const pan = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    const done = () => e.preventDefault();
    const digit = /^Digit([1-6])$/.exec(e.code);
    const at = (id, by) => { const i = $(id); i.value = +i.value + by; i.oninput({ target: i }); };
    if (pan && e.altKey) { this.moveBy(...this.onScreen(pan, 0.1)); this.save(); return done(); }
    if (typing && (pan || e.key === " " || e.key === "Home" || e.key === "End" || e.key.startsWith("Page"))) return;
    if (pan && this.state.ruling && this.state.ruler) { const [x, y] = this.onScreen(pan, 0.005); this.state.ruler[1] = [this.state.ruler[1][0] + x, this.state.ruler[1][1] + y]; this.dirty(); return done(); }
    const press = { n: "orientation", r: "ruler", 0: "fit", s: "save-picture", l: "copy-link", c: "contour", m: "cast", b: "compare", v: "evidence", k: "whole", "?": "help-open" }[e.key.toLowerCase()];
    if (digit && e.code !== "Digit0") { this.panels[e.shiftKey ? 0 : 1].choose(LAYERS[digit[1] - 1][0]); this.save(); return done(); }
    if (press) { $(press).click(); return done(); }
    if (e.key === " " && e.target.tagName !== "BUTTON") { this.play(); return done(); }
    if (e.key === "+" || e.key === "=") return this.zoomBy(1.25), done();
    if (e.key === "-") return this.zoomBy(0.8), done();
    if (e.key.toLowerCase() === "t") return $("threshold-main").focus(), done();
    if (e.code === "BracketLeft") return at(e.shiftKey ? "top-db" : "range-db", e.shiftKey ? -1 : -2), done();
    if (e.code === "BracketRight") return at(e.shiftKey ? "top-db" : "range-db", e.shiftKey ? 1 : 2), done();
    if (pan || e.key === "Home" || e.key === "End" || e.key.startsWith("Page")) {
      this.panels[1].slider.dispatchEvent(new KeyboardEvent("keydown", { key: e.key, shiftKey: e.shiftKey }));
      done();
    }
  }

  play() {
    this.playing = !this.playing;
    $("play").textContent = this.playing ? "Stop" : "Play";
    $("play").setAttribute("aria-pressed", String(this.playing));
    clearInterval(this.ticking);
    const go = () => {
      clearInterval(this.ticking);
      if (this.playing) this.ticking = setInterval(() => this.panels[1].slider.move(1), 1000 / +$("speed").value);
    };
    $("speed").onchange = go;
    go();
    if (!this.playing) this.dirty();
  }

  turn() {
    this.state.orientation = this.state.orientation === "north" ? "sonar" : "north";
    $("orientation").textContent = this.state.orientation === "north" ? "North up" : "Sonar up";
    this.save();
    this.dirty();
  }

  rule() {
    this.state.ruling = !this.state.ruling;
    if (!this.state.ruling) this.state.ruler = null;
    else {
      // For the keyboard: along the shadow, from the target away from the sonar.
      const view = this.current, c = this.scene.target?.centre ?? [0, 0], t = ((view?.aspect_deg ?? 0) * Math.PI) / 180;
      this.state.ruler = [[c[0], c[1]], [c[0] - Math.cos(t), c[1] - Math.sin(t)]];
    }
    $("ruler").setAttribute("aria-pressed", String(this.state.ruling));
    if (!this.state.ruler) $("measured").textContent = "";
    this.dirty();
  }

  fit() { Object.assign(this.state, { zoom: 1, centre: [0, 0] }); this.save(); this.dirty(); }

  savePicture() {
    const p = this.panels[1], canvas = p.slider.picture, out = new OffscreenCanvas(canvas.width, canvas.height + 26), g = out.getContext("2d");
    g.fillStyle = "#0b0f12"; g.fillRect(0, 0, out.width, out.height);
    g.drawImage(canvas, 0, 0); g.drawImage(p.slider.ring, 0, 0);
    g.fillStyle = "#c9d3d9"; g.font = "13px sans-serif";
    g.fillText(`${p.select.selectedOptions[0].text} · ${$("where").textContent}`, 8, out.height - 8, out.width - 16);
    out.convertToBlob({ type: "image/png" }).then((blob) => {
      const url = URL.createObjectURL(blob);
      this.download(url, `${p.layer}_${Math.round(this.current?.aspect_deg ?? 0)}.png`);
      setTimeout(() => URL.revokeObjectURL(url), 10000);
    });
  }

  async copyLink() {
    history.replaceState(null, "", this.link());
    try { await navigator.clipboard.writeText(location.href); $("copy-link").textContent = "Copied"; }
    catch { $("copy-link").textContent = "In the address bar"; }
    setTimeout(() => ($("copy-link").textContent = "Copy link"), 1500);
  }

  download(address, name = "") { Object.assign(document.createElement("a"), { href: address, download: name }).click(); }
}

window.csas = new App();
