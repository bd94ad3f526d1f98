import { coarseToFine, Loader } from "./loader.js";
import { Desk, newId } from "./desk.js";
import { inverse, isOther, LAYERS, OTHER_LAYERS, Panel } from "./panel.js";
import { Solid } from "./solid.js";

const $ = (id) => document.getElementById(id);
const DEFAULTS = { aspect: 0, layers: ["sub_aperture", "shadow"], zoom: 1, centre: [0, 0], orientation: "north", top: 18, range: 38, contour: true, cast: false, compare: false, evidence: false, overlay: false, truth: false, section: "off", cut: 0.5, follow: false, contact: "", camera: [], rulers: [], thresholds: {} };
const REST_MS = 160;
// So long must the circle be left alone before views that nobody asked for yet are decoded.
const IDLE_MS = 1000;
// Decoded of a view beyond what the circle shows: so much of its radius, for a picture that is moved a little.
const MARGIN = 0.12;
const RAD = Math.PI / 180;
// A ruler's error in length is 1 / cos of its angle to the ray from the sonar: 1.5 % at this one.
const ALONG_DEG = 10;
// Of a ruler's length so much must lie in the segmented shadow, where there is one.
const IN_SHADOW = 0.5;
// The picture that is saved, whatever the screen is.
const SAVED_PX = 1600;
const METHODS = { soft: "Soft carving", hard: "Hard carving", consensus: "Silhouettes" };

class App {
  constructor() {
    const held = $("content");
    const content = held && JSON.parse(held.textContent);
    const linked = this.fromLink();
    this.linkedLayers = !!linked.layers;
    this.framed = "zoom" in linked || "centre" in linked; // by the link; else the contact is gone to
    this.state = { ...structuredClone(DEFAULTS), ...linked, ruling: false };
    // Rulers that are not kept in the results folder; a link takes them along.
    this.rulers = this.state.rulers.map(([stamp, aspect, ...e]) => ({ id: newId("ruler"), stamp, aspect_deg: aspect, ends: [e.slice(0, 2), e.slice(2)] }));
    this.ruler = this.rulers.at(-1) ?? null;
    this.pick = null;
    this.scene = { sets: {}, pictures: {}, volumes: {}, track: [], target: null, dimensions: null, codes: { low_db: -32, step_db: 0.25 } };
    this.sorted = {};
    this.volumes = {};
    this.casts = new Map();
    this.stats = { drawn: 0, events: [], latency: [], surfaces: [], first: 0 };
    const startWorker = () => new Worker(this.workerAddress(content?.files));
    this.loader = new Loader(content?.files, startWorker, (address) => { if (this.awaits(address)) this.dirty(); }, (address) => this.partOf(address));
    this.panels = [new Panel($("panel-a"), this, this.state.layers[0], "Left"), new Panel($("panel-b"), this, this.state.layers[1], "Right")];
    this.desk = new Desk(this);
    this.startSurfaces(startWorker());
    // The first picture goes before the first object.
    setTimeout(() => this.startSolid(), 1500);
    this.controls();
    if (content) {
      $("link").textContent = "saved file";
      for (const id of ["save-html", "save-mesh-row", "save-circle", "report"]) $(id).hidden = true; // the server makes these
      this.all(content.scene);
    } else this.connect();
  }

  startSolid() {
    if (this.solid) return;
    this.solid = new Solid($("gl"), $("stage-note"), this);
    for (const name of ["track", "target", "volumes", "meshes"]) this.part(name);
    if (this.state.camera.length) this.solid.lookFrom(this.state.camera);
    else this.desk.goTo3d();
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
    this.away = !on;
    $("link").classList.toggle("on", on);
    this.loader.paused = !on;
    this.badge();
  }

  // How the run goes, in one line: a page that stands still is to be told from a graph that does.
  badge() {
    if (this.loader.files) return;
    const p = this.scene.progress, live = this.scene.live;
    let text = "connected", good = !this.away;
    if (this.away) text = "viewer is away: waiting for it";
    else if (live && p) {
      const of = `${p.views}${p.of ? ` of ${p.of}` : ""} views`;
      const newest = p.newest_s === null ? "" : `, newest ${p.newest_s < 120 ? `${p.newest_s} s` : `${Math.round(p.newest_s / 60)} min`} ago`;
      good = p.state === "running" || p.state === "finished";
      text = { running: `live: ${of}${p.rate ? ` at ${p.rate} /s` : ""}${newest}`, finished: `finished: ${of}`, silent: `the graph is silent for ${p.silent_s} s: ${of}${newest}`, waiting: `no graph is heard: ${of}` }[p.state] ?? of;
    } else if (live) [text, good] = ["live: waiting for a graph", false];
    else if (p?.state === "loading") text = `reading: ${this.views(this.guide).length} views`;
    else text = `${this.views(this.guide).length} views`;
    $("link").textContent = text;
    $("link").classList.toggle("on", good);
  }

  // What a picture that is empty waits for.
  awaited(panel) {
    const p = this.scene.progress, layer = panel.layer, known = this.scene.sets[layer]?.views.length ?? 0;
    if (known || panel.six && this.views(panel.six).length) return "loading the picture";
    if (!this.scene.instance) return this.away === undefined ? "connecting to the viewer" : "the viewer is away";
    if (layer === "reduced") return this.scene.reduced ? "making the views of 4°" : "needs the full-circle image, which this run has not";
    const what = panel.select.selectedOptions[0]?.text.toLowerCase() ?? layer;
    if (this.scene.live) {
      if (!p || p.state === "waiting") return "waiting for a graph: none is heard";
      if (p.state === "silent") return `the graph is silent for ${p.silent_s} s; waiting for ${what}`;
      return `waiting for ${what}: ${p.views}${p.of ? ` of ${p.of}` : ""} views have come`;
    }
    if (p?.state === "loading") return `reading the run: ${what} is to come`;
    return `this run holds no ${what}`;
  }

  notice(n) {
    if (n.type === "all") this.all(n.scene);
    else if (n.type === "view") {
      const set = (this.scene.sets[n.set] ??= { views: [] }), first = !set.views.length, at = set.views.findIndex((v) => v.stamp === n.view.stamp);
      if (at >= 0) set.views[at] = n.view; else set.views.push(n.view);
      delete this.sorted[n.set];
      if (first) this.settleLayers();
      if (this.scene.live && this.state.follow && n.set === this.guide && this.scene.progress?.state !== "finished") this.newest = n.view.aspect_deg;
      this.later();
    } else if (n.type === "part") {
      this.scene[n.part] = n.value;
      this.part(n.part);
      this.dirty();
    }
  }

  later() {
    this.timer ??= setTimeout(() => { this.timer = undefined; this.refetch(); if (this.newest !== undefined) this.setAspect(this.newest); this.newest = undefined; this.badge(); this.dirty(); }, 60);
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
    this.badge();
    $("follow-row").hidden = !scene.live;
    document.body.classList.toggle("live", !!scene.live);
    for (const name of ["track", "target", "volumes", "dimensions", "pictures", "damage", "reduced", "contacts", "report", "other", "desk", "meshes"]) this.part(name);
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
      if (this.solid && name === "target" && this.scene.target && !this.looked) {
        this.looked = true;
        if (!this.state.camera.length) this.solid.whole(false); // a link says where from, however late the target comes
      }
    } else if (name === "volumes" && this.solid) {
      for (const each of new Set(["main", "other", ...Object.keys(this.volumes), ...Object.keys(this.scene.volumes)])) if (this.scene.volumes[each]) this.fetchVolume(each); else this.dropVolume(each);
    } else if (name === "damage") {
      $("damage").hidden = !this.scene.damage;
      $("damage").textContent = $("damage").title = this.scene.damage ?? "";
      this.desk.show();
    } else if (name === "reduced") {
      if (this.scene.reduced && this.panels.some((p) => p.layer === "reduced")) this.wantReduced();
    } else if (name === "dimensions" || name === "truth" || name === "status") this.dimensions();
    else if (name === "progress") this.badge();
    else if (name === "meshes" && this.solid && this.scene.meshes?.truth) this.fetchTruth();
    else if (name === "contacts" || name === "report" || name === "desk" || name === "other") {
      this.derive();
      this.desk.show();
      this.dimensions();
      if (name === "other") {
        if (this.scene.other) $("title").textContent = `${this.scene.title} · B: ${this.scene.other.title}`;
        this.solid?.place();
        for (const p of this.panels) p.offer(this.scene.other ? [...LAYERS, ...OTHER_LAYERS] : LAYERS);
        this.settleLayers();
      }
    }
    if (name === "contacts" || name === "target") this.frame1st();
    if (name === "track" || name === "pictures") this.refetch();
  }

  // What the circle shows of each view, and which way is north.
  derive() {
    const r = this.scene.report, other = this.scene.other;
    this.north = r?.north_deg ?? 0;
// Heights are the target's; a view that was rejected is so for every contact.
    const heights = !this.contact || this.contact.volume === "main" ? r?.heights ?? [] : [];
    this.evidence = heights.length || r?.rejected?.length ? { heights, median: r.height_median_m, rejected: r.rejected ?? [] } : undefined;
    this.offset = other?.offset_m ?? [0, 0];
  }

  get contact() {
    const all = this.scene.contacts ?? [];
    return all.find((c) => c.id === this.state.contact) ?? all[0];
  }

  // Where the chosen contact is; of a live run that knows none yet, the volume that is carved.
  get place() {
    const c = this.contact, t = this.scene.target;
    if (c) return { centre: c.position_m, size: c.size_m, height: c.height_m ?? 0.4 };
    return t && { centre: t.centre, size: 0.75 * Math.max(t.size[0], t.size[1]), height: t.size[2] };
  }

  // Dimensions of the chosen contact in a second run: of its target, or of what lies nearest to a further one.
  get mate() {
    const { contact: c, scene: { other } } = this;
    if (!other) return null;
    if (!c || c.volume === "main") return other.dimensions;
    const off = (o) => Math.hypot(o.position_m[0] - c.position_m[0], o.position_m[1] - c.position_m[1]);
    const near = [...other.contacts].sort((a, b) => off(a) - off(b))[0];
    return near && off(near) < c.size_m / 2 ? near.dimensions : null;
  }

  frame1st() {
    if (this.framed || !this.place || !this.current) return;
    this.framed = true;
    this.zoomToContact();
  }

  // The contact with the shadow that it throws to whatever side, and a margin.
  zoomToContact() {
    const place = this.place, view = this.current;
    if (!place || !view) return this.fit();
    const ground = Math.hypot(view.sonar[0] - place.centre[0], view.sonar[1] - place.centre[1]);
    const shadow = (place.height * ground) / Math.max(0.1, view.sonar[2] - place.height);
    const reach = 1.15 * (place.size / 2 + shadow);
    this.state.zoom = Math.min(40, Math.max(1, this.sceneRadius / reach));
    this.state.centre = [place.centre[0], place.centre[1]];
    this.save();
    this.dirty();
  }

  // Pictures that nobody chose by hand show what there is, and what they were made for as soon as it is there.
  settleLayers() {
    const there = [...LAYERS, ...OTHER_LAYERS].map(([name]) => name).filter((name) => this.scene.sets[name]?.views.length);
    if (!there.length) return;
    const wish = this.scene.other ? ["shadow", "b.shadow"] : DEFAULTS.layers;
    this.panels.forEach((p, i) => {
      if (p.chosen) return;
      const layer = there.includes(wish[i]) ? wish[i] : there[Math.min(i, there.length - 1)];
      if (layer !== p.layer) { p.layer = p.select.value = layer; this.refetch(); }
    });
    this.frame1st();
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

  nearestOf(views, aspect = this.state.aspect) {
    if (views.near?.aspect === aspect) return views.near.best;
    let best = -1, least = 1e9;
    views.forEach((v, i) => {
      const off = Math.abs(((((v.aspect_deg - aspect + 540) % 360) + 360) % 360) - 180);
      if (off < least) [least, best] = [off, i];
    });
    views.near = { aspect, best };
    return best;
  }

  nearest(name) { return this.nearestOf(this.views(name)); }
  get current() { const views = this.views(this.guide); return views[this.nearestOf(views)]; }
  sameStamp(name, view) {
    const views = this.views(name);
    views.byStamp ??= new Map(views.map((v) => [v.stamp, v]));
    return views.byStamp.get(view.stamp);
  }
  contourAddress(run, mask) { return `api/contour/${mask.stamp}/${mask.rev}.json${run ? `?set=${run}shadow_mask` : ""}`; }
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
    // Outlines come last: few bytes, and a picture may be seen without.
    const runs = ["", "b."].flatMap((run) => coarseToFine(this.views(`${run}shadow_mask`)).map((mask) => this.contourAddress(run, mask)));
    this.loader.fetchAll([...new Set([...mixed, ...runs])]);
  }

  prefetch() {
    const wanted = [], ahead = Math.sign(this.velocity || 1), rest = !this.scrubbing() && !this.playing;
    for (const p of this.panels) {
      if (p.found?.wanted) wanted.push(p.found.wanted);
      if (p.six) wanted.push(...(p.sixWanted ?? []));
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
    const idle = this.idle(), left = this.idleIn();
    clearTimeout(this.idling);
    if (!idle && left > 0) this.idling = setTimeout(() => this.prefetch(), left + 20);
    this.loader.want([...new Set(wanted)], idle ? this.others() : []);
  }

  // All views of both pictures, the nearest to the cursor last.
  others() {
    const each = this.panels.filter((p) => p.isView).map((p) => {
      const views = this.views(p.layer), at = this.nearest(p.layer), n = views.length, order = [];
      for (let i = n >> 1; i >= 1; i--) order.push(views[(at + i) % n], views[(at - i + n) % n]);
      return order.map((v) => this.address(p.layer, v, "jpg"));
    });
    const longest = Math.max(0, ...each.map((l) => l.length)), mixed = [];
    for (let i = 0; i < longest; i++) for (const l of each) if (i >= longest - l.length) mixed.push(l[i - longest + l.length]);
    return mixed;
  }

  // Nothing is under way that this machine is needed for.
  idle() {
    const state = this.scene.progress?.state;
    if (this.playing || state === "running" || state === "loading" || document.hidden || !this.loader.filled) return false;
    return this.idleIn() <= 0;
  }

  // When (ms) it has been left alone for long enough.
  idleIn() { return IDLE_MS - (performance.now() - (this.moved ?? 0)); }

  // Whether a drawing lacks what was just decoded; an outline tells nothing.
  awaits(address) {
    return !address || !/^api\/view\/.*jpg$/.test(address) || this.panels.some((p) => !p.found?.bitmap || p.found.wanted === address && !p.found.exact || p.found.late || p.sixWanted?.includes(address) && p.six);
  }

  // Of a view's quick picture: the square round the circle, and what is decoded of it, as (x, y, width, height)
  // in whole pixels.
  partOf(address) {
    const [, kind, set, stamp, file] = address.split("/");
    const view = kind === "view" && file.endsWith(".jpg") && this.sameStamp(set, { stamp });
    if (!view) return undefined;
    const { A } = view, other = isOther(set) ? this.offset : [0, 0], x = this.state.centre[0] - other[0], y = this.state.centre[1] - other[1];
    const u = A[0] * x + A[1] * y + A[2], v = A[3] * x + A[4] * y + A[5], m = this.sceneRadius / this.state.zoom;
    const ru = m * Math.hypot(A[0], A[1]), rv = m * Math.hypot(A[3], A[4]);
    const square = (by, more) => {
      const x0 = Math.min(view.cols - 1, Math.max(0, Math.floor(u - by * ru) - more)), y0 = Math.min(view.rows - 1, Math.max(0, Math.floor(v - by * rv) - more));
      return [x0, y0, Math.min(view.cols, Math.max(1, Math.ceil(u + by * ru) + 1 + more)) - x0, Math.min(view.rows, Math.max(1, Math.ceil(v + by * rv) + 1 + more)) - y0];
    };
    return { shown: square(1, 1), decoded: square(1 + MARGIN, 2) };
  }

  async wantReduced() {
    if (this.loader.files || this.asked) return;
    this.asked = true;
    try { await fetch("api/reduced"); } finally { this.asked = false; }
  }

  // State

  setAspect(aspect, when = performance.now(), byHand = false) {
    // Whoever turns the circle wants to stay there.
    if (byHand && this.state.follow) this.state.follow = $("follow").checked = false;
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
    this.saving = setTimeout(() => history.replaceState(null, "", this.link()), 200); // a browser takes so many a second
  }

  link() {
    const s = this.state, kept = { ...s, layers: this.panels.map((p) => p.layer), rulers: this.rulers.map((r) => [r.stamp, r.aspect_deg, ...r.ends.flat()]) };
    if (this.solid?.moved) kept.camera = this.solid.seenFrom();
    delete kept.ruling;
    return `#${encodeURIComponent(JSON.stringify(kept, (_, v) => (typeof v === "number" ? +v.toFixed(4) : v)))}`;
  }

  fromLink() {
    let told = {};
    try { told = JSON.parse(decodeURIComponent(location.hash.slice(1))); } catch { /* no link of ours */ }
    // Whoever shortens or edits a link gets the default for what is not understood.
    const like = (a, b) => typeof a === typeof b && (typeof a !== "number" || Number.isFinite(a)) && (!Array.isArray(b) || !b.length || (Array.isArray(a) && a.length === b.length && a.every((v, i) => like(v, b[i]))));
    const kept = Object.fromEntries(Object.entries(told ?? {}).filter(([key, value]) => value !== null && key in DEFAULTS && like(value, DEFAULTS[key])));
    if (kept.layers) kept.layers = kept.layers.map((name, i) => ([...LAYERS, ...OTHER_LAYERS].some(([each]) => each === name) ? name : DEFAULTS.layers[i]));
    kept.rulers = (kept.rulers ?? []).filter((r) => Array.isArray(r) && r.length === 6 && /^[0-9]{1,20}$/.test(r[0]) && r.slice(1).every(Number.isFinite)).slice(0, 100);
    if (kept.camera && !(kept.camera.length === 6 && kept.camera.every(Number.isFinite))) delete kept.camera;
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
      const bearing = (810 + this.north - view.aspect_deg) % 360, t = new Date(Number(BigInt(view.stamp) / 1000000n)).toISOString().slice(0, 23).replace("T", " ");
      $("where").textContent = `aspect ${view.aspect_deg.toFixed(1)}° · sonar bears ${bearing.toFixed(1).padStart(5, "0")}° · ${t}Z`;
    }
    this.say();
    // Nothing is offered that there is nothing to make of.
    $("save-circle").disabled = $("save-picture").disabled = !view;
    $("report").disabled = !this.scene.contacts?.length;
    const shown = this.panels.map((p) => p.found?.about?.stamp ?? "").join();
    const all = this.panels.every((p) => p.found?.bitmap), late = this.panels.some((p) => p.found?.late || p.found?.partly);
    if (all && !this.stats.first) { this.stats.first = performance.now(); setTimeout(() => this.startSolid(), 50); }
    if (shown !== this.stats.shown && all) { this.stats.drawn++; this.stats.shown = shown; }
    if (this.stats.pending !== undefined && all && !late) {
      this.stats.latency.push(performance.now() - this.stats.pending);
      if (this.stats.latency.length > 5000) this.stats.latency.shift();
      this.stats.pending = undefined;
    }
  }

  // Rulers

  // Those of the view that is shown, and those kept of it: each belongs to its aspect.
  rulersHere() {
    const stamp = this.current?.stamp;
    return this.allRulers().filter((r) => r.stamp === stamp);
  }

  allRulers() { return [...this.desk.keptRulers(), ...this.rulers]; }

  newRuler(a, b) {
    const view = this.current;
    this.ruler = { id: newId("ruler"), stamp: view?.stamp ?? "0", aspect_deg: view?.aspect_deg ?? 0, ends: [a, b] };
    this.rulers.push(this.ruler);
    this.desk.later();
    return this.ruler;
  }

  moveEnd(ruler, end, to) {
    ruler.ends[end] = to;
    ruler.touched = true;
    this.ruler = ruler;
    this.dirty();
  }

  ruled(ruler) {
    if (ruler.kept && ruler.touched) this.desk.keepRuler(ruler);
    ruler.touched = false;
    this.desk.later();
    this.save();
  }

  // Distance, and the height that the shadow implies; why not, where it runs along none.
  measured({ ends: [a, b], stamp }) {
    const distance = Math.hypot(b[0] - a[0], b[1] - a[1]), view = this.sameStamp(this.guide, { stamp });
    if (!view) return { distance, why: "its view is not there" };
    const [sx, sy, sz] = view.sonar, ra = Math.hypot(a[0] - sx, a[1] - sy), rb = Math.hypot(b[0] - sx, b[1] - sy);
    const off = Math.acos(Math.min(1, Math.max(-1, ((b[0] - a[0]) * (a[0] - sx) + (b[1] - a[1]) * (a[1] - sy)) / (distance * ra || 1)))) / RAD;
    if (!(distance > 0)) return { distance, why: "drag along a shadow, away from the sonar" };
    if (off > ALONG_DEG) return { distance, why: `it runs ${off.toFixed(0)}° off the ray from the sonar, expected ${ALONG_DEG}° at most` };
    const share = this.inShadow(view, a, b);
    if (share < IN_SHADOW) return { distance, why: `${Math.round(100 * share)} % of it lies in the segmented shadow, expected ${100 * IN_SHADOW} % or more` };
    const psi = Math.atan2(sz, rb), L = rb - ra;
    return { distance, L, psi: psi / RAD, height: L * Math.tan(psi) };
  }

  // Share of a line that lies in a view's segmented shadow; 1 where nobody knows.
  inShadow(view, a, b) {
    const mask = this.sameStamp("shadow_mask", view), lines = mask && this.loader.lines(this.contourAddress("", mask));
    if (!lines) return 1;
    const A = mask.A;
    let inside = 0;
    for (let i = 0; i < 50; i++) {
      const f = (i + 0.5) / 50, x = a[0] + f * (b[0] - a[0]), y = a[1] + f * (b[1] - a[1]);
      const u = A[0] * x + A[1] * y + A[2], v = A[3] * x + A[4] * y + A[5];
      let odd = false;
      for (const line of lines)
        for (let j = 0, n = line.length, k = n - 2; j < n; k = j, j += 2)
          if (line[j + 1] > v !== line[k + 1] > v && u < ((line[k] - line[j]) * (v - line[j + 1])) / (line[k + 1] - line[j + 1]) + line[j]) odd = !odd;
      inside += odd;
    }
    return inside / 50;
  }

  say() {
    const here = this.rulersHere(), ruler = here.includes(this.ruler) ? this.ruler : here.at(-1);
    let text = "";
    if (ruler) {
      const m = this.measured(ruler);
      text = m.height === undefined ? `${m.distance.toFixed(2)} m; no height: ${m.why}`
        : `${m.distance.toFixed(2)} m; shadow L = ${m.L.toFixed(2)} m → h = L · tan ψ = ${m.L.toFixed(2)} m × tan ${m.psi.toFixed(1)}° = ${m.height.toFixed(2)} m (ψ at the shadow's tip)`;
    } else if (this.state.ruling) text = "Ruler: drag along a shadow, away from the sonar.";
    else text = this.panels[1].slider.told(this.current?.aspect_deg);
    if ($("measured").textContent !== text) $("measured").textContent = text;
  }

  // Linked picking: a point of a picture is its line from the sonar, a point on the shape its shadow.

  pickGround(at) {
    const old = this.pick?.ground, near = old && Math.hypot(old[0] - at[0], old[1] - at[1]) < (0.03 * this.sceneRadius) / this.state.zoom;
    this.pick = near ? null : { ground: at };
    this.solid?.showPick();
    this.dirty();
  }

  pickPoint(point) {
    this.pick = point && { point };
    this.solid?.showPick();
    this.dirty();
  }

  // Where what is picked lies in a view: a point of the seabed itself, or the shadow P · X of a point.
  pickedGround(view) {
    const { ground, point } = this.pick ?? {};
    if (!point) return ground;
    const [x, y, z] = point, P = view.P, w = P[8] * x + P[9] * y + P[10] * z + P[11];
    const u = (P[0] * x + P[1] * y + P[2] * z + P[3]) / w, v = (P[4] * x + P[5] * y + P[6] * z + P[7]) / w;
    const [a, b, c, d, e, f] = inverse(view.A);
    return [a * u + b * v + c, d * u + e * v + f];
  }

  // The object

  workerAddress(files) {
    const address = "static/worker.js";
    if (!files) return address;
    return (this.madeWorker ??= URL.createObjectURL(new Blob([atob(files[address].split(",")[1])], { type: "text/javascript" })));
  }

  startSurfaces(worker) {
    this.worker = worker;
    this.nextSurface = new Map();
    this.worker.onmessage = ({ data }) => {
      if (data.did === "surface" && (!this.volumes[data.name] || !data.faces)) this.busySurface = false; // of a run that is gone
      else if (data.did === "surface") {
        this.stats.surfaces.push(performance.now() - data.asked);
        this.busySurface = false;
        this.solid.set(data.name, data);
        const row = $(`row-${data.name}`);
        if (row) row.dataset.triangles = data.faces.length / 3;
        if (data.name === this.castName) this.casts.clear();
        const next = this.nextSurface.entries().next().value;
        if (next) { this.nextSurface.delete(next[0]); this.surface(...next[1]); }
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
      const auto = about.threshold === null ? 1 : Math.max(1, 254 * Math.sqrt(about.threshold));
      this.auto = { ...this.auto, [name]: auto };
      const row = $(`row-${name}`), label = METHODS[about.method] ?? about.method;
      // Further objects, and a second run's, stand at the threshold that they were measured at.
      if (!row) return void (this.sayWhose(), this.surface(name, auto, performance.now()));
      row.hidden = false;
      row.querySelector("label span").textContent = label;
      $(`tag-${name}`).textContent = label;
      this.sayWhose();
      const input = $(`threshold-${name}`);
      input.max = about.method === "soft" ? 254 : 160;
      const chosen = this.codeOf(name);
      input.value = chosen;
      this.threshold(name, chosen);
    } catch { /* a newer volume has come, or the server is away: it is told again */ }
  }

  // The second method carves the target alone: no other contact stands beside it.
  sayWhose() {
    const { other } = this.volumes, further = Object.keys(this.volumes).some((name) => name.startsWith("object_"));
    if (other) $("tag-other").textContent = `${METHODS[other.method] ?? other.method}${further ? ": the target alone" : ""}`;
  }

  dropVolume(name) {
    if ($(`row-${name}`)) $(`row-${name}`).hidden = true;
    if (!this.volumes[name]) return;
    delete this.volumes[name];
    this.worker.postMessage({ do: "drop", name });
    this.solid.set(name, { points: new Float32Array(0), faces: new Uint32Array(0) });
    this.solid.evidence(name, { codes: new Uint8Array(0), shape: [0, 0, 0], origin: [0, 0, 0], voxel: 1 }, 1);
    if (!$(`row-${name}`)) return;
    delete $(`row-${name}`).dataset.triangles;
    $(`tag-${name}`).textContent = "";
    if (name !== "main") return;
    clearTimeout(this.exact);
    this.casts.clear();
    this.surfaceMeasures = this.thresholdQuery = undefined;
    this.dimensions();
  }

  // The threshold that a surface stands at, as a code: the slider knows it only in whole ones. One of another
  // method means nothing.
  codeOf(name) { return this.state.thresholds[this.volumes[name].method] ?? this.auto[name]; }

  // Voxels somewhat above the threshold too: they are what another one would take in.
  showEvidence(name, code) { this.solid.evidence(name, this.volumes[name], Math.min(254, code * 1.25)); }

  threshold(name, code) {
    const value = (code / 254) ** 2, row = $(`row-${name}`);
    const hard = this.volumes[name]?.method === "consensus" && code <= 1.5;
    row.querySelector("output").textContent = hard ? "hard carving" : value < 0.1 ? value.toFixed(4) : value.toFixed(3);
    row.querySelector("button").disabled = Math.abs(code - this.auto[name]) < 1e-9;
    this.surface(name, code, performance.now());
    if (this.state.evidence && this.volumes[name]) this.showEvidence(name, code);
    if (name !== "main" || this.loader.files) return;
    clearTimeout(this.exact);
    this.exact = setTimeout(() => this.measureAt(value), 300);
  }

  surface(name, code, asked) {
    // Only the newest threshold of each is worked on after the one under way.
    if (this.busySurface) return void this.nextSurface.set(name, [name, code, asked]);
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

  // Of the chosen contact; of the target where that was not carved.
  get castName() { return this.volumes[this.contact?.volume] ? this.contact.volume : "main"; }

  castLines(view) {
    const key = `${this.castName} ${view.stamp} ${view.rev}`;
    if (!this.casts.has(key)) {
      this.casts.set(key, null);
      this.worker.postMessage({ do: "cast", name: this.castName, key, P: view.P, rows: view.rows, cols: view.cols });
    }
    return this.casts.get(key);
  }

  async fetchTruth() {
    const { rev } = this.scene.meshes.truth;
    if (this.truthRev === rev) return;
    this.truthRev = rev;
    try { this.solid.truth(JSON.parse(await (await this.loader.get(`api/surface-of/truth/${rev}.json`)).text())); } catch { this.truthRev = undefined; }
    $("truth-row").hidden = this.truthRev === undefined;
  }

  // A heading counts from the scene's x-axis; who reads the circle wants a true bearing. An object has no
  // front: 0° to 180°.
  withAxis(d) {
    if (!Number.isFinite(d?.heading_rad)) return d;
    const bears = (rad) => 90 + this.north - rad / RAD, [low, high] = d.intervals?.heading_rad ?? [];
    const axis = ((bears(d.heading_rad) % 180) + 180) % 180, turn = axis - bears(d.heading_rad);
    const intervals = { ...d.intervals, ...(Number.isFinite(low) && Number.isFinite(high) ? { axis: [bears(high) + turn, bears(low) + turn] } : {}) };
    return { ...d, axis, intervals };
  }

  // Of the chosen contact: what was measured, with the truth, the surface at the threshold, and a second run.
  dimensions() {
    const c = this.contact, target = !c || c.volume === "main";
    const d = this.withAxis(target ? this.scene.dimensions ?? c?.dimensions : c.dimensions);
    // Beside a second run there is room for nothing else.
    const o = this.withAxis(this.mate), t = o ? null : this.withAxis(target ? this.scene.truth : c.truth), m = target && !o ? this.surfaceMeasures : null, table = $("dimensions");
    table.replaceChildren();
    table.classList.toggle("pair", !!o);
    const row = (cells, head) => {
      const tr = table.insertRow();
      cells.forEach((cell, i) => {
        const [text, mark] = Array.isArray(cell) ? cell : [cell];
        const made = Object.assign(document.createElement(text && (head || !i) ? "th" : "td"), { textContent: text, className: mark ?? "" });
        if (made.tagName === "TH") made.scope = head ? "col" : "row";
        tr.append(made);
      });
    };
    $("why-here").hidden = !m?.object;
    if (!d && !m) return void row(["", c?.reason ?? (this.scene.volumes.main ? "carved; not measured yet" : this.scene.status || "nothing carved yet")]);
    row(["", "found, 95 %", ...(t ? ["truth"] : []), ...(m?.object ? ["surface here"] : []), ...(o ? ["run B", "B − A"] : [])], true);
    const deg = 1 / RAD, half = (one, key) => (one?.intervals?.[key] ? (one.intervals[key][1] - one.intervals[key][0]) / 2 : undefined);
    // As far to either side, or down and up.
    const spread = (v, [low, high], digits) => {
      const [down, up] = [v - low, high - v].map((reach) => Math.abs(reach).toFixed(digits));
      return down === up ? `± ${up}` : `−${down} +${up}`;
    };
    const told = (v, ends, digits, unit) => (v === undefined || v === null ? "—" : `${v.toFixed(digits).padStart(unit === "°" ? 5 : 0, "0")}${ends === undefined ? "" : ` ${spread(v, ends, digits)}`} ${unit}`);
    const names = [["length_m", "Length", "m", 2], ["width_m", "Width", "m", 2], ["height_m", "Height", "m", 2], ["volume_m3", "Volume", "m³", 3], ["axis", "Axis bears", "°", 1]];
    for (const [key, label, unit, digits] of names) {
      const v = d?.[key], i = half(d, key);
      if (v === undefined && !m?.object) continue;
      if (key === "axis" && v === undefined) continue;
      const cells = [label, told(v, d?.intervals?.[key], digits, unit)];
      if (t) cells.push(t[key] === undefined || t[key] === null ? "" : told(t[key], undefined, digits, unit));
      if (m?.object) cells.push(m[key] === undefined ? "" : told(m[key], undefined, digits, unit));
      if (o) {
        cells.push(told(o[key], o.intervals?.[key], digits, unit));
        let off = (o[key] ?? NaN) - v;
        if (key === "axis") off = ((off + 270) % 180) - 90;
        // Two independent 95 % intervals: theirs of the difference.
        const both = i === undefined || half(o, key) === undefined ? undefined : Math.hypot(i, half(o, key));
        cells.push(Number.isFinite(off) ? [`${off > 0 ? "+" : ""}${off.toFixed(digits)} ${unit}`, both !== undefined && Math.abs(off) > both ? "differs" : "agrees"] : "—");
      }
      row(cells);
    }
    if (m && !m.object) row(["", "no object at this threshold"]);
  }

  // Controls

  controls() {
    const s = this.state, press = (id, work) => ($(id).onclick = work);
    const check = (id, work) => { $(id).checked = s[id]; $(id).onchange = () => { s[id] = $(id).checked; work?.(); this.save(); this.dirty(); this.solid?.dirty(); }; };
    check("contour");
    check("cast");
    check("compare", () => ($("tag-other").hidden = !s.compare));
    check("overlay");
    check("truth");
    check("follow");
    for (const [id, key] of [["section", "section"], ["cut", "cut"]]) {
      $(id).value = s[key];
      $(id).oninput = $(id).onchange = () => { s[key] = key === "cut" ? +$(id).value : $(id).value; $("cut").hidden = s.section === "off"; this.save(); this.solid?.dirty(); };
    }
    $("cut").hidden = s.section === "off";
    for (const name of ["main", "other"]) $(`auto-${name}`).onclick = () => { delete s.thresholds[this.volumes[name]?.method]; $(`threshold-${name}`).value = this.auto[name]; this.threshold(name, this.auto[name]); this.save(); };
    press("zoom-contact", () => this.zoomToContact());
    press("report", () => this.download("api/report.pdf?contact=" + encodeURIComponent(this.contact?.id ?? "")));
    press("save-circle", () => this.download(`api/circle.gif?contact=${encodeURIComponent(this.contact?.id ?? "")}&set=${this.panels[1].isView && !isOther(this.panels[1].layer) ? this.panels[1].layer : "shadow"}`));
    check("evidence", () => { if (s.evidence) for (const name of ["main", "other"]) if (this.volumes[name]) this.showEvidence(name, this.codeOf(name)); });
    $("tag-other").hidden = !s.compare;
    $("whole").onchange = () => { this.solid?.whole($("whole").checked); if (!$("whole").checked) this.desk.goTo3d(); };
    press("play", () => this.play());
    press("orientation", () => this.turn());
    press("ruler", () => this.rule());
    press("fit", () => this.fit());
    press("help-open", () => $("help").showModal());
    press("save-picture", () => this.savePicture());
    press("copy-link", () => this.copyLink());
    press("save-html", () => this.download(`api/export.html?step=2`));
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
    const sized = () => { const em = parseFloat(getComputedStyle(document.documentElement).fontSize) / 13; for (const p of this.panels) if (p.slider.em !== em) { p.slider.em = em; p.slider.resize(); } };
    addEventListener("resize", sized);
    sized();
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
    const typing = e.target.matches?.("input:not([type=checkbox]), select, textarea"), writing = e.target.matches?.("textarea, input[type=text]");
    if (writing) return;
    const pan = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    const done = () => e.preventDefault();
    const digit = /^Digit([1-9])$/.exec(e.code);
    const at = (id, by) => { const i = $(id); i.value = +i.value + by; i.oninput({ target: i }); };
    if (pan && e.altKey) { this.moveBy(...this.onScreen(pan, 0.1)); this.save(); return done(); }
    if (typing && (pan || e.key === " " || e.key === "Home" || e.key === "End" || e.key.startsWith("Page"))) return;
    if (pan && this.state.ruling) {
      const ruler = this.rulersHere().includes(this.ruler) ? this.ruler : this.offeredRuler(), [x, y] = this.onScreen(pan, 0.005), [u, v] = ruler.ends[1];
      this.moveEnd(ruler, 1, [u + x, v + y]);
      clearTimeout(this.rulerRest);
      this.rulerRest = setTimeout(() => this.ruled(ruler), 500);
      return done();
    }
    const press = { n: "orientation", r: "ruler", 0: "fit", s: "save-picture", l: "copy-link", c: "contour", m: "cast", b: "compare", v: "evidence", k: "whole", z: "zoom-contact", o: "overlay", "?": "help-open" }[e.key.toLowerCase()];
    if (digit && LAYERS[digit[1] - 1]) { this.panels[e.shiftKey ? 0 : 1].choose(LAYERS[digit[1] - 1][0]); this.save(); return done(); }
    if (e.key === "Delete" && this.ruler && this.rulersHere().includes(this.ruler)) { this.desk.dropRuler(this.ruler); return done(); }
    if (e.key === "," || e.key === ".") { this.desk.step(e.key === "." ? 1 : -1); return done(); }
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
    $("ruler").setAttribute("aria-pressed", String(this.state.ruling));
    this.dirty();
  }

  // For the keyboard: along the shadow, from the contact away from the sonar.
  offeredRuler() {
    const view = this.current, c = this.place?.centre ?? [0, 0], t = Math.atan2(c[1] - (view?.sonar[1] ?? 0), c[0] - (view?.sonar[0] ?? 0));
    return this.newRuler([c[0], c[1]], [c[0] + Math.cos(t), c[1] + Math.sin(t)]);
  }

  fit() { Object.assign(this.state, { zoom: 1, centre: [0, 0] }); this.save(); this.dirty(); }

  // Drawn anew, as large as the views are worth: not what the screen happens to show.
  savePicture() {
    const p = this.panels[1], slider = p.slider, px = SAVED_PX, k = px / slider.side, line = Math.round(px / 40);
    const out = new OffscreenCanvas(px, px + 2 * line), g = out.getContext("2d"), one = new OffscreenCanvas(px, px);
    p.paint({ canvas: one, side: px, radius: p.radius * k, k: k * slider.em });
    g.fillStyle = "#0b0f12"; g.fillRect(0, 0, out.width, out.height);
    g.drawImage(one, 0, 0);
    if (!p.six) {
      const ring = new OffscreenCanvas(px, px);
      slider.paintRing(ring.getContext("2d"), px, k, true);
      g.drawImage(ring, 0, 0);
    }
    g.fillStyle = "#c9d3d9"; g.font = `${Math.round(px / 58)}px sans-serif`;
    g.fillText(`${this.scene.title} · ${p.select.selectedOptions[0].text} · ${$("where").textContent}`, line, px + 1.3 * line, px - 2 * line);
    out.convertToBlob({ type: "image/png" }).then((blob) => {
      const url = URL.createObjectURL(blob);
      this.download(url, `${this.fileName()}_${p.layer}_${Math.round(this.current?.aspect_deg ?? 0)}.png`);
      setTimeout(() => URL.revokeObjectURL(url), 10000);
    });
  }

  fileName() { return (this.scene.title || "csas").replace(/[^A-Za-z0-9._-]+/g, "_"); }

  async copyLink() {
    history.replaceState(null, "", this.link());
    try { await navigator.clipboard.writeText(location.href); $("copy-link").textContent = "Copied"; }
    catch { $("copy-link").textContent = "In the address bar"; }
    setTimeout(() => ($("copy-link").textContent = "Copy link"), 1500);
  }

  download(address, name = "") { Object.assign(document.createElement("a"), { href: address, download: name }).click(); }
}

window.csas = new App();
