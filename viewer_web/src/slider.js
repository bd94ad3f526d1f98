// <csas-slider>: a circle that stands for the sonar's track, with the picture inside. Aspects count
// counter-clockwise from the right (east), as on the chart.
const TAU = 2 * Math.PI;

export class CsasSlider extends HTMLElement {
  aspects = []; // degrees, ascending, of the views that are there
  step = 1; // degrees between them
  index = -1;
  wheel = undefined; // degrees that the wheel of hues is turned by; undefined: there is none

  connectedCallback() {
    if (this.picture) return;
    this.picture = this.appendChild(document.createElement("canvas"));
    this.ring = this.appendChild(document.createElement("canvas"));
    this.tabIndex = 0;
    this.setAttribute("role", "slider");
    this.setAttribute("aria-valuemin", "0");
    this.setAttribute("aria-valuemax", "360");
    this.setAttribute("aria-label", this.getAttribute("label") ?? "Aspect");
    new ResizeObserver(() => this.resize()).observe(this);
    this.addEventListener("pointerdown", (e) => {
      if (!this.onRing(e)) return;
      this.setPointerCapture(e.pointerId);
      this.dragging = e.pointerId;
      this.point(e);
      e.stopImmediatePropagation();
      this.focus({ preventScroll: true });
      e.preventDefault();
    });
    this.addEventListener("pointermove", (e) => {
      if (this.dragging === e.pointerId) this.point(e);
      else this.style.cursor = this.onRing(e) ? "grab" : "default";
    });
    for (const end of ["pointerup", "pointercancel"])
      this.addEventListener(end, () => (this.dragging = undefined));
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

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    this.side = Math.min(this.clientWidth, this.clientHeight);
    for (const c of [this.picture, this.ring]) {
      c.width = c.height = Math.max(1, Math.round(this.side * ratio));
      c.style.width = c.style.height = `${this.side}px`;
      c.style.left = `${(this.clientWidth - this.side) / 2}px`;
      c.style.top = `${(this.clientHeight - this.side) / 2}px`;
    }
    this.drawRing();
    this.dispatchEvent(new CustomEvent("resized"));
  }

  get radius() { return this.side / 2 - 15; } // of the circle, CSS pixels
  get disc() { return this.side / 2 - 30; } // of the picture

  polar(e) {
    const box = this.ring.getBoundingClientRect();
    const x = e.clientX - box.left - this.side / 2, y = this.side / 2 - (e.clientY - box.top);
    return [Math.hypot(x, y), (((Math.atan2(y, x) / TAU) * 360) % 360 + 360) % 360, x, -y];
  }

  onRing(e) { return this.polar(e)[0] > this.disc; }
  point(e) { this.choose(this.nearest(this.polar(e)[1]), e.timeStamp); }

  nearest(aspect) {
    let best = -1, least = 1e9;
    this.aspects.forEach((a, i) => {
      const off = Math.abs(((a - aspect + 540) % 360) - 180);
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
    const same = this.aspects === aspects && this.step === step;
    if (same && this.index === index && this.wheel === this.shownWheel) return;
    Object.assign(this, { aspects, step, index, shownWheel: this.wheel });
    if (index >= 0) {
      this.setAttribute("aria-valuenow", aspects[index].toFixed(2).replace(/\.?0+$/, ""));
      this.setAttribute("aria-valuetext", `aspect ${aspects[index].toFixed(1)} degrees`);
    }
    if (!same) this.background = undefined;
    this.drawRing();
  }

  drawRing() {
    const c = this.ring, size = c.width, k = size / (this.side || 1);
    const g = c.getContext("2d");
    if (!this.background || this.background.width !== size) {
      this.background = new OffscreenCanvas(size, size);
      this.drawCircle(this.background.getContext("2d"), size, k);
    }
    g.clearRect(0, 0, size, size);
    g.drawImage(this.background, 0, 0);
    if (this.wheel !== undefined) this.drawWheel(g, size, k);
    if (this.index < 0) return;
    const a = (this.aspects[this.index] / 360) * TAU;
    g.beginPath();
    g.arc(size / 2 + this.radius * k * Math.cos(a), size / 2 - this.radius * k * Math.sin(a), 10 * k, 0, TAU);
    g.fillStyle = "#29d85a";
    g.fill();
    g.lineWidth = 2 * k;
    g.strokeStyle = "#04140a";
    g.stroke();
  }

  drawWheel(g, size, k) {
    const r = 24 * k, x = size - r - 6 * k, y = r + 6 * k;
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
    // What lies outside of the picture's disc covers the picture: cheaper than clipping that, every time.
    g.fillStyle = "#12181d";
    g.beginPath();
    g.rect(0, 0, size, size);
    g.arc(size / 2, size / 2, this.disc * k, 0, TAU);
    g.fill("evenodd");
    g.translate(size / 2, size / 2);
    g.lineWidth = 5 * k;
    g.strokeStyle = "#2a343c"; // no view here (yet)
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
    g.lineWidth = k;
    g.strokeStyle = "#0b0f12";
    g.beginPath();
    for (let d = 0; d < 360; d += 10) {
      const a = (d / 360) * TAU, r = d % 90 ? 2 : 4;
      g.moveTo((this.radius - r) * k * Math.cos(a), (this.radius - r) * k * Math.sin(a));
      g.lineTo((this.radius + r) * k * Math.cos(a), (this.radius + r) * k * Math.sin(a));
    }
    g.stroke();
  }
}
customElements.define("csas-slider", CsasSlider);
