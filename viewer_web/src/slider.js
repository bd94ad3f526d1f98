// <csas-slider>: a circle that stands for the sonar's track, with the picture inside. Aspects count
// counter-clockwise from the right (east), as on the chart; the numbers round it are true bearings.
const TAU = 2 * Math.PI;
const RED = [255, 92, 72], GREEN = [96, 190, 150];

export class CsasSlider extends HTMLElement {
  aspects = []; // degrees, ascending, of the views that are there
  step = 1; // degrees between them
  index = -1;
  wheel = undefined; // degrees that the wheel of hues is turned by; undefined: there is none
  turn = 0; // degrees that the circle is turned by, counter-clockwise: it lies as the picture does
  north = 0; // degrees of true north from the scene's +y, counter-clockwise
  evidence = undefined; // { heights: [[aspect, m, unexplained, lit]], median, rejected: [[aspect, reason]] }
  em = 1; // size of the text over 13 px

  connectedCallback() {
    if (this.picture) return;
    this.picture = this.appendChild(document.createElement("canvas"));
    this.ring = this.appendChild(document.createElement("canvas"));
    // What moves with every view is no part of the circle, which is then not painted again.
    this.dot = Object.assign(this.appendChild(document.createElement("span")), { className: "dot" });
    this.tabIndex = 0;
    this.setAttribute("role", "slider");
    this.setAttribute("aria-valuemin", "0");
    this.setAttribute("aria-valuemax", "360");
    this.setAttribute("aria-valuenow", "0");
    this.setAttribute("aria-label", this.getAttribute("label") ?? "Aspect");
    new ResizeObserver(() => this.resize()).observe(this);
    for (const [when, on] of [["beforeprint", true], ["afterprint", false]])
      addEventListener(when, () => { this.onPaper = on; this.drawRing(); this.dispatchEvent(new CustomEvent("resized")); });
    this.addEventListener("pointerdown", (e) => {
      if (!this.onRing(e)) return;
      this.setPointerCapture(e.pointerId);
      this.dragging = e.pointerId;
      // A circle that turns with the picture is taken hold of: what is under the pointer stays there.
      this.held = { angle: this.polar(e)[1], aspect: this.aspects[this.index] ?? 0, x: e.clientX, y: e.clientY, moved: false };
      if (!this.turns) this.point(e);
      e.stopImmediatePropagation();
      this.focus({ preventScroll: true });
      e.preventDefault();
    });
    this.addEventListener("pointermove", (e) => {
      if (this.dragging === e.pointerId) this.drag(e);
      else this.style.cursor = this.onRing(e) ? "grab" : "default";
    });
    for (const end of ["pointerup", "pointercancel"])
      this.addEventListener(end, (e) => {
        if (this.dragging === e.pointerId && this.turns && !this.held.moved && end === "pointerup") this.point(e);
        this.dragging = undefined;
      });
    // One finger scrolls the page past the pictures (app.css), but on the circle, and two of them, are ours.
    this.addEventListener("touchstart", (e) => {
      if (e.touches.length > 1 || this.takesTouch?.(e.touches[0]) || this.onRing(e.touches[0])) e.preventDefault();
    }, { passive: false });
    this.addEventListener("wheel", (e) => {
      if (!this.onRing(e)) return;
      e.preventDefault();
      e.stopImmediatePropagation();
      this.move(e.deltaY < 0 ? 1 : -1, e.timeStamp);
    }, { passive: false });
    this.addEventListener("keydown", (e) => {
      if (e.altKey || e.ctrlKey || e.metaKey) return;
      const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 }[e.key];
      if (steps) this.move(steps * (e.shiftKey && Math.abs(steps) === 1 ? 10 : 1), e.timeStamp);
      else if (e.key === "Home") this.choose(0, e.timeStamp);
      else if (e.key === "End") this.choose(this.aspects.length - 1, e.timeStamp);
      else return;
      e.preventDefault();
      e.stopPropagation();
    });
  }

  drag(e) {
    if (!this.turns) return this.point(e);
    if (Math.hypot(e.clientX - this.held.x, e.clientY - this.held.y) > 4) this.held.moved = true;
    if (this.held.moved) this.choose(this.nearest(this.held.aspect - (this.polar(e)[1] - this.held.angle)), e.timeStamp);
  }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    this.side = Math.min(this.clientWidth, this.clientHeight);
    this.corner = [(this.clientWidth - this.side) / 2, (this.clientHeight - this.side) / 2];
    for (const c of [this.picture, this.ring]) {
      c.width = c.height = Math.max(1, Math.round(this.side * ratio));
      c.style.width = c.style.height = `${this.side}px`;
      c.style.left = `${this.corner[0]}px`;
      c.style.top = `${this.corner[1]}px`;
    }
    this.background = undefined;
    this.drawRing();
    this.dispatchEvent(new CustomEvent("resized"));
  }

  // Of the circle and of the picture, CSS pixels; where there is no room for them, none.
  get radius() { return Math.max(0, this.side / 2 - 24 * this.em); }
  get disc() { return Math.max(0, this.radius - 18 * this.em); }

  polar(e) {
    const box = this.ring.getBoundingClientRect();
    const x = e.clientX - box.left - this.side / 2, y = this.side / 2 - (e.clientY - box.top);
    return [Math.hypot(x, y), (((Math.atan2(y, x) / TAU) * 360) % 360 + 360) % 360, x, -y];
  }

  onRing(e) { const r = this.polar(e)[0]; return !this.bare && r > this.disc && r < this.side / 2; }
  point(e) { this.choose(this.nearest(this.polar(e)[1] - this.turn), e.timeStamp); }

  nearest(aspect) {
    let best = -1, least = 1e9;
    this.aspects.forEach((a, i) => {
      const off = Math.abs(((((a - aspect + 540) % 360) + 360) % 360) - 180);
      if (off < least) [least, best] = [off, i];
    });
    return best;
  }

  move(by, when) {
    const n = this.aspects.length;
    // Two keys may come between two drawings: the step goes from what was chosen, not from what is drawn.
    const at = this.aspect === undefined ? this.index : this.nearest(this.aspect);
    if (n) this.choose((((at + by) % n) + n) % n, when);
  }

  choose(index, when = performance.now()) {
    if (index < 0 || index >= this.aspects.length) return;
    this.dispatchEvent(new CustomEvent("aspect", { bubbles: true, detail: { aspect: this.aspects[index], when } }));
  }

  show(aspects, step, index) {
    const same = this.aspects === aspects && this.step === step && this.evidence === this.shownEvidence && this.north === this.shownNorth;
    const lies = same && this.wheel === this.shownWheel && this.turn === this.shownTurn;
    if (lies && this.index === index) return;
    Object.assign(this, { aspects, step, index, shownWheel: this.wheel, shownTurn: this.turn, shownEvidence: this.evidence, shownNorth: this.north });
    if (index >= 0) {
      this.setAttribute("aria-valuenow", aspects[index].toFixed(2).replace(/\.?0+$/, ""));
      this.setAttribute("aria-valuetext", `aspect ${aspects[index].toFixed(1)} degrees`);
    }
    if (!same) this.background = undefined;
    if (lies) this.moveDot();
    else this.drawRing();
  }

  drawRing() {
    const c = this.ring, size = c.width, k = size / (this.side || 1);
    this.paintRing(c.getContext("2d"), size, k, this.onPaper);
    this.moveDot();
  }

  // Where the cursor is on the circle, CSS pixels.
  get cursor() {
    const a = ((this.aspects[this.index] + this.turn) / 360) * TAU;
    return [this.side / 2 + this.radius * Math.cos(a), this.side / 2 - this.radius * Math.sin(a)];
  }

  moveDot() {
    this.dot.hidden = this.index < 0;
    if (this.index < 0) return;
    const [x, y] = this.cursor, [left, top] = this.corner, r = 10 * this.em;
    this.dot.style.transform = `translate(${left + x - r}px, ${top + y - r}px)`;
  }

  // Also on another canvas, larger than the screen's: the picture that is saved.
  paintRing(g, size, k, cursor) {
    let background = this.background?.width === size ? this.background : undefined;
    if (!background) {
      background = new OffscreenCanvas(size, size);
      this.drawCircle(background.getContext("2d"), size, k);
      if (g.canvas === this.ring) this.background = background;
    }
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.clearRect(0, 0, size, size);
    g.translate(size / 2, size / 2);
    g.rotate((-this.turn / 360) * TAU);
    g.drawImage(background, -size / 2, -size / 2);
    g.setTransform(1, 0, 0, 1, 0, 0);
    if (this.wheel !== undefined) this.drawWheel(g, size, k);
    this.drawDegrees(g, size, k);
    if (!cursor || this.index < 0) return;
    const [x, y] = this.cursor;
    g.beginPath();
    g.arc(x * k, y * k, 9 * k * this.em, 0, TAU);
    g.fillStyle = "#29d85a";
    g.fill();
    g.lineWidth = 2 * k;
    g.strokeStyle = "#04140a";
    g.stroke();
  }

  // True bearings, clockwise from north.
  drawDegrees(g, size, k) {
    const r = (this.radius + 14 * this.em) * k, every = this.side < 300 ? 90 : 30;
    g.font = `${10.5 * k * this.em}px system-ui, sans-serif`;
    g.textAlign = "center";
    g.textBaseline = "middle";
    g.fillStyle = "#aab8c2";
    for (let bearing = 0; bearing < 360; bearing += every) {
      const a = ((90 + this.north - bearing + this.turn) / 360) * TAU;
      const text = bearing % 90 ? String(bearing).padStart(3, "0") : "NESW"[bearing / 90];
      g.fillText(text, size / 2 + r * Math.cos(a), size / 2 - r * Math.sin(a));
    }
    g.textBaseline = "alphabetic";
  }

  drawWheel(g, size, k) {
    const r = 22 * k * this.em, x = size - r - 2 * k, y = r + 2 * k;
    for (let d = 0; d < 360; d += 3) {
      g.beginPath();
      g.moveTo(x, y);
      g.arc(x, y, r, ((this.wheel - d - 3.5) / 360) * TAU, ((this.wheel - d) / 360) * TAU);
      g.fillStyle = `hsl(${d} 100% 50%)`;
      g.fill();
    }
    g.beginPath();
    g.arc(x, y, r * 0.45, 0, TAU);
    g.fillStyle = "#12181d";
    g.fill();
  }

  drawCircle(g, size, k) {
    const em = this.em;
    // What lies outside of the picture's disc covers the picture: cheaper than clipping that, every time.
    g.fillStyle = "#12181d";
    g.beginPath();
    // Beyond the corners: the circle may be turned.
    g.rect(-size, -size, 3 * size, 3 * size);
    g.arc(size / 2, size / 2, this.disc * k, 0, TAU);
    g.fill("evenodd");
    g.translate(size / 2, size / 2);
    if (this.evidence) this.drawEvidence(g, k);
    g.lineWidth = 5 * k * em;
    g.strokeStyle = "#333f48"; // no view here (yet)
    g.beginPath();
    g.arc(0, 0, this.radius * k, 0, TAU);
    g.stroke();
    g.strokeStyle = "#8fa3b0";
    const half = (this.step / 720) * TAU * 1.02;
    g.beginPath();
    for (const aspect of this.aspects) {
      const a = (-aspect / 360) * TAU;
      g.moveTo(this.radius * k * Math.cos(a - half), this.radius * k * Math.sin(a - half));
      g.arc(0, 0, this.radius * k, a - half, a + half);
    }
    g.stroke();
    g.strokeStyle = "#e64fd0"; // rejected
    g.beginPath();
    for (const [aspect] of this.evidence?.rejected ?? []) {
      const a = (-aspect / 360) * TAU;
      g.moveTo(this.radius * k * Math.cos(a - half), this.radius * k * Math.sin(a - half));
      g.arc(0, 0, this.radius * k, a - half, a + half);
    }
    g.stroke();
    g.lineWidth = k;
    g.strokeStyle = "#0b0f12";
    g.beginPath();
    for (let d = 0; d < 360; d += 10) {
      const a = ((d - this.north) / 360) * TAU, r = d % 90 ? 2 : 4;
      g.moveTo((this.radius - r * em) * k * Math.cos(a), (this.radius - r * em) * k * Math.sin(a));
      g.lineTo((this.radius + r * em) * k * Math.cos(a), (this.radius + r * em) * k * Math.sin(a));
    }
    g.stroke();
  }

  // A bar a view, inwards from the circle: half of the room is the run's median height; the redder, the more of
  // the view's shadow is not explained by what was found, or lies on seabed that is lit.
  drawEvidence(g, k) {
    if (!this.disc) return; // not laid out yet: there is no ring to draw on
    const { heights, median } = this.evidence, outer = this.radius - 4 * this.em, room = outer - this.disc - this.em;
    const half = (this.step / 720) * TAU * 0.9;
    for (const [aspect, height, unexplained, lit] of heights) {
      if (!(median > 0)) break;
      const a = (-aspect / 360) * TAU, inner = outer - room * Math.min(1, Math.max(0.08, height / (2 * median)));
      const bad = Math.min(1, Math.max(unexplained ?? 0, lit ?? 0));
      g.beginPath();
      g.arc(0, 0, outer * k, a - half, a + half);
      g.arc(0, 0, inner * k, a + half, a - half, true);
      g.fillStyle = `rgb(${GREEN.map((v, i) => Math.round(v + bad * (RED[i] - v))).join()})`;
      g.fill();
    }
  }

  // What the evidence says of the view at an aspect, in words.
  told(aspect) {
    if (!this.evidence || aspect === undefined) return "";
    const near = ([other]) => Math.abs(((((other - aspect + 540) % 360) + 360) % 360) - 180) < Math.max(0.05, this.step / 2);
    const rejected = this.evidence.rejected.find(near);
    if (rejected) return `not used: ${rejected[1]}`;
    const found = this.evidence.heights.find(near);
    if (!found) return "";
    return `height ${found[1].toFixed(2)} m, ${Math.round(100 * (found[2] ?? 0))} % unexplained${found[3] > 0.005 ? `, ${Math.round(100 * found[3])} % lit` : ""}`;
  }
}
customElements.define("csas-slider", CsasSlider);
