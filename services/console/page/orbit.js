// Control of a stream's virtual camera by drag, touch, wheel and keys. All viewers share one camera; the last request wins.

import { call } from "./api.js";

const MOST_DEG = 75, LEAST_ZOOM = 0.25, MOST_ZOOM = 4;
const STEP_DEG = 5, STEP_ZOOM = 1.15;
const DEG_PER_WIDTH = 120;
const SEND_MS = 100;
const START = { azimuth_deg: 0, elevation_deg: 0, zoom: 1 };
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** `controls` receives the reset button. Call `shown(virtual)` with the camera of each displayed image. */
export class Orbit {
  constructor(stream, canvas, report) {
    Object.assign(this, { stream, canvas, report, wanted: { ...START }, sent_ms: 0, timer: null, sending: false, pointers: new Map(), moved_ms: 0 });
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.move(0, 0, Math.exp(-event.deltaY / 500)); }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const over of ["pointerup", "pointercancel"]) canvas.addEventListener(over, (event) => this.pointers.delete(event.pointerId));
    this.where = document.createElement("output");
    const reset = Object.assign(document.createElement("button"), { type: "button", textContent: "Reset view", id: "orbit-reset" });
    reset.addEventListener("click", () => this.to({ ...START }));
    this.controls = document.createElement("p");
    this.controls.className = "orbit-controls";
    this.controls.append(reset, this.where, "drag or arrow keys turn, wheel or + − zoom");
  }

  /** Adopt the camera of the displayed image, which another viewer may have moved, unless a recent request of this page is pending. */
  shown(virtual) {
    if (!virtual) return;
    const name = (value) => `${value > 0 ? "+" : ""}${value.toFixed(0)}°`;
    this.where.value = `${name(virtual.azimuth_deg)} across, ${name(virtual.elevation_deg)} up, ×${virtual.zoom.toFixed(1)}`;
    if (performance.now() - this.moved_ms > 1500) this.wanted = { ...virtual };
  }

  key(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const zooms = { "+": STEP_ZOOM, "=": STEP_ZOOM, "-": 1 / STEP_ZOOM };
    if (event.key in turns) this.move(...turns[event.key].map((turn) => turn * STEP_DEG), 1);
    else if (event.key in zooms) this.move(0, 0, zooms[event.key]);
    else if (event.key === "Home" || event.key === "0") this.to({ ...START });
    else return;
    event.preventDefault();
  }

  /** One pointer rotates; two pointers zoom by their distance. The scene follows the pointer, so the camera moves the opposite way. */
  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const apart = () => { const [a, b] = [...this.pointers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1; };
    const old = this.pointers.size === 2 ? apart() : 0;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pointers.size === 2) return this.move(0, 0, apart() / old);
    const scale = DEG_PER_WIDTH / this.canvas.clientWidth;
    this.move((before[0] - event.clientX) * scale, (event.clientY - before[1]) * scale, 1);
  }

  move(azimuth, elevation, zoom) {
    this.to({
      azimuth_deg: clamp(this.wanted.azimuth_deg + azimuth, -MOST_DEG, MOST_DEG),
      elevation_deg: clamp(this.wanted.elevation_deg + elevation, -MOST_DEG, MOST_DEG),
      zoom: clamp(this.wanted.zoom * zoom, LEAST_ZOOM, MOST_ZOOM),
    });
  }

  /** Request a camera position, at most ten times a second; only the newest position is sent. */
  to(wanted) {
    this.wanted = wanted;
    this.moved_ms = performance.now();
    this.timer ??= setTimeout(() => this.send(), Math.max(0, SEND_MS - (this.moved_ms - this.sent_ms)));
  }

  async send() {
    this.sent_ms = performance.now();
    const asked = this.wanted;
    await this.report(() => call("PUT", `/v1/streams/${this.stream}/camera`, asked));
    this.timer = null;
    if (asked !== this.wanted) this.to(this.wanted);
  }

  close() {
    clearTimeout(this.timer);
  }
}
