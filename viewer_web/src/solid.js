// The carved object in 3-D: one camera, one or two surfaces side by side.
import {
  AmbientLight, BoxGeometry, BufferAttribute, BufferGeometry, Color, DirectionalLight, EdgesGeometry, GridHelper, Group, Line, LineBasicMaterial,
  LineLoop, LineSegments, Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Points, PointsMaterial, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

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
    for (const name of ["main", "other"]) this.sides[name] = this.side(name === "main" ? 0x9fb6c4 : 0xc4b08f);
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
    const grid = new GridHelper(20, 40, 0x3c4d59, 0x222d35);
    grid.rotation.x = Math.PI / 2;
    const mesh = new Mesh(new BufferGeometry(), new MeshStandardMaterial({ color: colour, roughness: 0.85, flatShading: true }));
    const points = new Points(new BufferGeometry(), new PointsMaterial({ size: 2.5, sizeAttenuation: false, vertexColors: true }));
    const track = new LineLoop(new BufferGeometry(), new LineBasicMaterial({ color: 0x8fa3b0 }));
    const sonar = new Mesh(new SphereGeometry(1, 16, 12), new MeshBasicMaterial({ color: 0x29d85a }));
    const ray = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0x29d85a, transparent: true, opacity: 0.7 }));
    const box = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: 0x33506a }));
    mesh.visible = false;
    scene.add(grid, new Group().add(mesh, points, track, sonar, ray, box));
    return { scene, mesh, points, track, sonar, ray, box };
  }

  look(centre, size) {
    if (!this.renderer) return;
    this.centre = new Vector3(...centre);
    this.controls.target.copy(this.centre);
    this.camera.position.set(centre[0] + 0.9 * size, centre[1] - 1.3 * size, centre[2] + 0.9 * size);
    this.size = size;
    this.controls.update();
    this.dirty();
  }

  whole(on) {
    if (!this.renderer) return;
    const { track, target } = this.app.scene;
    if (on && track.length) {
      const far = Math.max(...track.map((p) => Math.hypot(p[0], p[1])));
      this.look([0, 0, 0], 1.5 * far);
    } else if (target) this.look([target.centre[0], target.centre[1], target.size[2] / 3], 1.1 * Math.max(...target.size));
  }

  set(name, { points, faces }) {
    const side = this.sides[name];
    if (!side) return;
    side.mesh.geometry.dispose();
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(points, 3));
    geometry.setIndex(new BufferAttribute(faces, 1));
    geometry.computeVertexNormals();
    side.mesh.geometry = geometry;
    side.mesh.visible = faces.length > 0;
    side.triangles = faces.length / 3;
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
        side.box.geometry = new EdgesGeometry(new BoxGeometry(...target.size));
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
      side.ray.geometry = new BufferGeometry().setFromPoints([from, to]);
    }
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

  render() {
    const { canvas, renderer, camera } = this, w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w || !h) return;
    const ratio = Math.min(devicePixelRatio, 2), both = this.app.state.compare;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(w, h, false);
    }
    const shown = both ? ["main", "other"] : ["main"], part = w / shown.length;
    camera.aspect = part / h;
    camera.updateProjectionMatrix();
    shown.forEach((name, i) => {
      const side = this.sides[name], { evidence } = this.app.state;
      side.mesh.material.transparent = evidence;
      side.mesh.material.opacity = evidence ? 0.25 : 1;
      side.points.visible = evidence;
      side.sonar.scale.setScalar(camera.position.distanceTo(side.sonar.position) * 0.012);
      renderer.setViewport(i * part, 0, part, h);
      renderer.setScissor(i * part, 0, part, h);
      renderer.render(side.scene, camera);
    });
  }
}
