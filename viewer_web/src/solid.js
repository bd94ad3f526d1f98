// The carved object in 3-D: one camera, one or two surfaces side by side.
import {
  AmbientLight, BufferAttribute, BufferGeometry, CanvasTexture, Color, DirectionalLight, DoubleSide, Group, Line, LineBasicMaterial,
  LineLoop, LineSegments, Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Plane, Points, PointsMaterial, Raycaster, Scene, SphereGeometry, Sprite,
  SpriteMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

// Long lines are made of short ones: of one with an end behind the camera, software renderers draw nothing.
const PIECE_M = 0.5, GRID_M = 10;
const NONE = { points: new Float32Array(0), faces: new Uint32Array(0) };
const COLOURS = { main: 0x9fb6c4, other: 0xc4b08f, further: 0x8fb8a0, truth: 0xff6ec7, pick: 0xff7ad9 };

// Shapes of a second run.
const ofSecond = (name) => name === "b" || name.startsWith("b_");

function pieces(from, to) {
  const n = Math.max(1, Math.min(400, Math.ceil(from.distanceTo(to) / PIECE_M)));
  return Array.from({ length: n + 1 }, (_, i) => from.clone().lerp(to, i / n));
}

function seabedGrid() {
  const fine = [], coarse = [];
  for (let at = -GRID_M; at <= GRID_M; at += 0.5)
    for (let x = -GRID_M; x < GRID_M; x += PIECE_M) {
      const list = Number.isInteger(at) ? coarse : fine;
      list.push(at, x, 0, at, x + PIECE_M, 0, x, at, 0, x + PIECE_M, at, 0);
    }
  const lines = (list, color) => new LineSegments(new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(list), 3)), new LineBasicMaterial({ color, depthWrite: false }));
  // Drawn first and without depth: an axis that lies on one of its lines is seen.
  const grid = new Group();
  grid.renderOrder = -1;
  return grid.add(lines(fine, 0x222d35), lines(coarse, 0x3c4d59));
}

function boxLines(size) {
  const [x, y, z] = size.map((v) => v / 2), list = [], corner = (i) => new Vector3(i & 1 ? x : -x, i & 2 ? y : -y, i & 4 ? z : -z);
  for (let a = 0; a < 8; a++)
    for (const bit of [1, 2, 4]) {
      if (a & bit) continue;
      const line = pieces(corner(a), corner(a | bit));
      for (let i = 1; i < line.length; i++) list.push(line[i - 1], line[i]);
    }
  return new BufferGeometry().setFromPoints(list);
}

function label(text, colour = "#c9d3d9") {
  const canvas = document.createElement("canvas"), g = canvas.getContext("2d");
  canvas.width = 128; canvas.height = 64;
  g.font = "40px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
  g.lineWidth = 8; g.strokeStyle = "#0b0f12"; g.strokeText(text, 64, 32);
  g.fillStyle = colour; g.fillText(text, 64, 32);
  const made = new Sprite(new SpriteMaterial({ map: new CanvasTexture(canvas), depthTest: false, sizeAttenuation: false }));
  made.scale.set(0.09, 0.045, 1);
  return made;
}

function surface(colour, more = {}) {
  const mesh = new Mesh(new BufferGeometry(), new MeshStandardMaterial({ color: colour, roughness: 0.85, flatShading: true, side: DoubleSide, ...more }));
  mesh.visible = false;
  return mesh;
}

function fill(mesh, { points, faces }) {
  mesh.geometry.dispose();
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(points, 3));
  geometry.setIndex(new BufferAttribute(faces, 1));
  geometry.computeVertexNormals();
  mesh.geometry = geometry;
  mesh.visible = faces.length > 0;
}

export class Solid {
  constructor(canvas, note, app) {
    this.canvas = canvas;
    this.app = app;
    this.sides = {};
    try {
      this.renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    } catch {
      note.textContent = "This browser has no WebGL: the 3-D view is off, all else works.";
      return;
    }
    this.renderer.setScissorTest(true);
    this.camera = new PerspectiveCamera(40, 1, 0.01, 5000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.dirty());
    this.controls.addEventListener("end", () => { this.moved = true; app.save(); });
    this.further = {}; // name → mesh: objects beside the target, and a second run's
    this.plane = new Plane(new Vector3(-1, 0, 0), 0);
    for (const name of ["main", "other"]) this.sides[name] = this.side(COLOURS[name]);
    this.picking();
    new ResizeObserver(() => this.dirty()).observe(canvas);
    this.look([0, 0, 0.2], 2);
  }

  side(colour) {
    const scene = new Scene();
    scene.background = new Color(0x0b0f12);
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(2, -3, 5);
    const back = new DirectionalLight(0x88aaff, 0.8);
    back.position.set(-3, 2, 1);
    scene.add(new AmbientLight(0xffffff, 0.7), sun, back);
    const mesh = surface(colour), axes = new Group(), more = new Group();
    const over = surface(COLOURS.other, { transparent: true, opacity: 0.45, depthWrite: false }), truth = surface(COLOURS.truth, { wireframe: true, transparent: true, opacity: 0.6 });
    const picked = new Line(new BufferGeometry(), new LineBasicMaterial({ color: COLOURS.pick, depthTest: false }));
    const spot = new Mesh(new SphereGeometry(1, 12, 8), new MeshBasicMaterial({ color: COLOURS.pick, depthTest: false }));
    picked.visible = spot.visible = false;
    const points = new Points(new BufferGeometry(), new PointsMaterial({ size: 2.5, sizeAttenuation: false, vertexColors: true }));
    const track = new LineLoop(new BufferGeometry(), new LineBasicMaterial({ color: 0x8fa3b0 }));
    const sonar = new Mesh(new SphereGeometry(1, 16, 12), new MeshBasicMaterial({ color: 0x29d85a }));
    const ray = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0x29d85a, transparent: true, opacity: 0.7 }));
    const box = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: 0x33506a }));
    scene.add(seabedGrid(), axes, new Group().add(mesh, more, over, truth, points, track, sonar, ray, box, picked, spot));
    return { scene, mesh, more, over, truth, points, track, sonar, ray, box, axes, picked, spot };
  }

  // Axes at the corner of what is looked at, in metres east, north and up, and where true north is.
  axes() {
    const { centre, size } = this, half = 0.42 * size, step = size > 8 ? 5 : size > 3 ? 1 : size > 1.4 ? 0.5 : 0.2;
    const at = [0, 1].map((i) => Math.round((centre.getComponent(i) - half) / step) * step), n = Math.max(1, Math.round((2 * half) / step));
    for (const side of Object.values(this.sides)) {
      side.axes.traverse((o) => { o.geometry?.dispose(); o.material?.map?.dispose(); o.material?.dispose(); });
      side.axes.clear();
      const line = (points, colour) => side.axes.add(new Line(new BufferGeometry().setFromPoints(points), new LineBasicMaterial({ color: colour })));
      const write = (text, x, y, z, colour) => { const made = label(text, colour); made.position.set(x, y, z); side.axes.add(made); };
      const origin = new Vector3(at[0], at[1], 0), far = n * step, digits = step < 1 ? 1 : 0;
      const up = Math.max(step, Math.ceil(this.height / step) * step);
      for (const [d, colour, length] of [[[1, 0, 0], 0xe07a6a, far], [[0, 1, 0], 0x7ac07a, far], [[0, 0, 1], 0x6a9ae0, up]]) {
        const direction = new Vector3(...d);
        line(pieces(origin, origin.clone().addScaledVector(direction, length)), colour);
        const every = Math.max(1, Math.ceil(length / step / 4));
        // The corner and the end, where others are written, have none.
        for (let i = 1; i * step <= (d[2] ? 1 : 0.95) * length + 1e-9; i += every) {
          const p = origin.clone().addScaledVector(direction, i * step), told = p.dot(direction);
          write(told.toFixed(digits), p.x - (d[0] ? 0 : 0.04 * size), p.y - (d[1] ? 0 : 0.04 * size), p.z);
        }
      }
      write("x m", at[0] + 1.03 * far, at[1] - 0.04 * size, 0, "#e07a6a");
      write("y m", at[0] - 0.04 * size, at[1] + 1.03 * far, 0, "#7ac07a");
      write("z m", at[0], at[1], up + 0.07 * size, "#6a9ae0");
      const t = ((90 + (this.app.north ?? 0)) * Math.PI) / 180, tip = new Vector3(at[0] + far + 0.12 * size * Math.cos(t), at[1] + 0.12 * size * (1 + Math.sin(t)), 0);
      line([new Vector3(at[0] + far, at[1] + 0.12 * size, 0), tip], 0xffffff);
      write("N", tip.x + 0.06 * size * Math.cos(t), tip.y + 0.06 * size * Math.sin(t), 0, "#ffffff");
    }
  }

  picking() {
    let pressed;
    this.canvas.addEventListener("pointerdown", (e) => (pressed = e));
    this.canvas.addEventListener("pointerup", (e) => {
      if (!pressed || Math.hypot(e.clientX - pressed.clientX, e.clientY - pressed.clientY) > 4) return;
      this.app.pickPoint(this.hit(e.clientX, e.clientY));
    });
  }

  // The point of the shape under a place on the screen.
  hit(x, y) {
    const box = this.canvas.getBoundingClientRect(), both = this.app.state.compare, w = box.width / (both ? 2 : 1);
    const name = both && x - box.left > w ? "other" : "main", side = this.sides[name];
    const at = new Vector2((2 * ((x - box.left) % w)) / w - 1, 1 - (2 * (y - box.top)) / box.height);
    const ray = new Raycaster();
    ray.setFromCamera(at, this.camera);
    const there = ray.intersectObjects([side.mesh, ...side.more.children].filter((m) => m.visible), false).find((h) => !this.cutting || this.plane.distanceToPoint(h.point) >= 0);
    return there && there.point.toArray();
  }

  // A point on the shape with the ray that throws its shadow; or the line from the sonar to a place of the seabed.
  showPick() {
    const pick = this.app.pick, view = this.app.current;
    for (const side of Object.values(this.sides)) {
      side.picked.visible = side.spot.visible = !!pick && !!view;
      if (!pick || !view) continue;
      const ground = this.app.pickedGround(view), from = new Vector3(...view.sonar), to = new Vector3(ground[0], ground[1], 0);
      side.picked.geometry.dispose();
      side.picked.geometry = new BufferGeometry().setFromPoints(pieces(from, to));
      side.spot.position.copy(pick.point ? new Vector3(...pick.point) : to);
    }
    this.dirty();
  }

  truth({ points, faces }) {
    for (const side of Object.values(this.sides)) fill(side.truth, { points: new Float32Array(points), faces: new Uint32Array(faces) });
    this.dirty();
  }

  // A second run's shape is moved as its pictures are.
  place() {
    const [x, y] = this.app.offset ?? [0, 0];
    for (const [name, meshes] of Object.entries(this.further)) if (ofSecond(name)) for (const mesh of meshes) mesh.position.set(x, y, 0);
    this.dirty();
  }

  // Where the camera is and what it looks at, for a link.
  seenFrom() { return [...this.camera.position.toArray(), ...this.controls.target.toArray()]; }

  lookFrom([x, y, z, ...target]) {
    if (!this.renderer) return;
    this.moved = true;
    this.look(target, Math.max(0.5, Math.hypot(x - target[0], y - target[1], z - target[2]) / 1.8));
    this.moved = true;
    this.camera.position.set(x, y, z);
    this.controls.update();
    this.dirty();
  }

  look(centre, size) {
    if (!this.renderer) return;
    this.moved = false;
    this.height = this.app.place?.height ?? 0.5;
    this.centre = new Vector3(...centre);
    this.controls.target.copy(this.centre);
    this.camera.position.set(centre[0] + 0.9 * size, centre[1] - 1.3 * size, centre[2] + 0.9 * size);
    this.size = size;
    this.axes();
    this.controls.update();
    this.dirty();
  }

  whole(on) {
    if (!this.renderer) return;
    const { track, target } = this.app.scene;
    if (on && track.length) {
      // All of the circle, however wide or high the window is.
      const far = Math.max(...track.map((p) => Math.hypot(...p))), half = (this.camera.fov * Math.PI) / 360;
      const aspect = (this.canvas.clientWidth / (this.app.state.compare ? 2 : 1)) / Math.max(1, this.canvas.clientHeight);
      this.look([0, 0, 0], far);
      const away = new Vector3(0.9, -1.3, 0.9).setLength((1.05 * far) / Math.sin(Math.atan(Math.tan(half) * Math.min(1, aspect || 1))));
      this.camera.position.copy(away);
      this.controls.update();
      this.dirty();
    } else if (target) this.look([target.centre[0], target.centre[1], target.size[2] / 3], 1.1 * Math.max(...target.size));
  }

  set(name, { points, faces }) {
    if (!this.renderer) return;
    const side = this.sides[name], shape = { points, faces };
    if (side) {
      fill(side.mesh, shape);
      side.triangles = faces.length / 3;
      if (name === "other") for (const each of Object.values(this.sides)) fill(each.over, shape);
    } else {
      this.further[name] ??= Object.values(this.sides).map((each) => {
        const mesh = ofSecond(name) ? surface(COLOURS.other, { transparent: true, opacity: 0.55 }) : surface(COLOURS.further);
        each.more.add(mesh);
        return mesh;
      });
      this.further[name].forEach((mesh, i) => {
        fill(mesh, shape.faces.length ? shape : NONE);
        // The second method carves the target alone.
        if (i && !ofSecond(name)) mesh.visible = false;
      });
      this.place();
    }
    this.dirty();
  }

  // Voxels that may be object: the less speaks against them, the brighter.
  evidence(name, volume, limit) {
    const side = this.sides[name];
    if (!side) return;
    side.points.geometry.dispose();
    const { codes, shape, origin, voxel } = volume, [, ny, nx] = shape, at = [], colours = [];
    for (let i = 0; i < codes.length; i++) {
      if (codes[i] >= limit) continue;
      at.push(origin[0] + (i % nx) * voxel, origin[1] + (((i / nx) | 0) % ny) * voxel, origin[2] + ((i / (nx * ny)) | 0) * voxel);
      const f = codes[i] / limit;
      colours.push(1, 1 - 0.6 * f, 0.9 - 0.8 * f);
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(at), 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
    side.points.geometry = geometry;
    this.dirty();
  }

  surroundings() {
    const { track, target } = this.app.scene;
    for (const side of Object.values(this.sides)) {
      side.track.geometry.dispose();
      side.track.geometry = new BufferGeometry().setFromPoints(track.map((p) => new Vector3(...p)));
      side.box.visible = !!target;
      if (target) {
        side.box.geometry.dispose();
        side.box.geometry = boxLines(target.size);
        side.box.position.set(...target.centre);
      }
    }
    this.dirty();
  }

  sonar(view) {
    if (!this.renderer || !view || this.shown === view) return;
    this.shown = view;
    const from = new Vector3(...view.sonar), to = this.app.scene.target ? new Vector3(...this.app.scene.target.centre) : new Vector3();
    for (const side of Object.values(this.sides)) {
      side.sonar.position.copy(from);
      side.ray.geometry.dispose();
      side.ray.geometry = new BufferGeometry().setFromPoints(pieces(from, to));
    }
    if (this.app.pick) this.showPick();
    this.dirty();
  }

  dirty() {
    if (!this.renderer || this.waiting) return;
    this.waiting = true;
    // Scrubbing goes first: the object follows once the cursor rests, or twice a second while it plays.
    const draw = () => requestAnimationFrame(() => {
      if (this.app.scrubbing() && !this.app.playing) return void setTimeout(draw, 120);
      this.waiting = false;
      this.render();
    });
    setTimeout(draw, this.app.scrubbing() ? 500 : 0);
  }

  // What lies on the near side of the plane is taken away.
  section() {
    const { section, cut } = this.app.state, target = this.app.scene.target, place = this.app.place;
    this.cutting = section !== "off" && !!place;
    this.renderer.localClippingEnabled = this.cutting;
    if (this.cutting) {
      const axis = { x: [-1, 0, 0], y: [0, 1, 0], z: [0, 0, -1] }[section], i = "xyz".indexOf(section);
      const span = Math.max(place.size, 0.4) * 1.2, low = i === 2 ? 0 : place.centre[i] - span / 2, high = i === 2 ? Math.max(place.height * 1.3, target?.size[2] ?? 0) : low + span;
      const at = low + cut * (high - low);
      this.plane.normal.set(...axis);
      this.plane.constant = -axis[i] * at;
    }
    for (const side of Object.values(this.sides))
      for (const mesh of [side.mesh, side.over, side.truth, ...side.more.children]) {
        const planes = this.cutting ? [this.plane] : [];
        if ((mesh.material.clippingPlanes?.length ?? 0) !== planes.length) mesh.material.clippingPlanes = planes;
      }
  }

  render() {
    const { canvas, renderer, camera } = this, w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w || !h) return;
    const ratio = Math.min(devicePixelRatio, 2), both = this.app.state.compare;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(w, h, false);
    }
    this.section();
    const shown = both ? ["main", "other"] : ["main"], part = w / shown.length;
    camera.aspect = part / h;
    camera.updateProjectionMatrix();
    shown.forEach((name, i) => {
      const side = this.sides[name], { evidence } = this.app.state;
      side.mesh.material.transparent = evidence;
      side.mesh.material.opacity = evidence ? 0.25 : 1;
      side.points.visible = evidence;
      side.over.visible = this.app.state.overlay && !both && this.sides.other.triangles > 0;
      side.truth.visible = this.app.state.truth && !!side.truth.geometry.index;
      side.spot.scale.setScalar(camera.position.distanceTo(side.spot.position) * 0.008);
      side.sonar.visible = side.ray.visible = !!this.shown;
      side.sonar.scale.setScalar(camera.position.distanceTo(side.sonar.position) * 0.012);
      renderer.setViewport(i * part, 0, part, h);
      renderer.setScissor(i * part, 0, part, h);
      renderer.render(side.scene, camera);
    });
  }
}
