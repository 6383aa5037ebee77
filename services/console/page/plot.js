// Line plot of the most recent values, with its axis.

const KEPT = 300;
const STEPS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];

/** Plots the most recent values; null is a gap. The canvas matches the size in device pixels, so that text is not stretched. */
export class Plot {
  constructor(canvas, { from_zero = true } = {}) {
    Object.assign(this, { canvas, from_zero, values: [], due: false });
    new ResizeObserver(() => this.plan()).observe(canvas);
  }

  clear() {
    this.values = [];
    this.plan();
  }

  add(value) {
    this.values.push(Number.isFinite(value) ? value : null);
    if (this.values.length > KEPT) this.values.shift();
    this.plan();
  }

  plan() {
    if (this.due) return;
    this.due = true;
    requestAnimationFrame(() => { this.due = false; this.draw(); });
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return; // its page is hidden
    const pen = this.canvas.getContext("2d"), scale = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * scale); // clears the canvas
    this.canvas.height = Math.round(height * scale);
    pen.scale(scale, scale);
    const known = this.values.filter((value) => value !== null);
    if (known.length === 0) return;
    const bottom = this.from_zero ? 0 : Math.min(...known);
    const span = Math.max(Math.max(...known) - bottom, 1);
    const lines = Math.max(1, Math.min(4, Math.floor((height - 24) / 22)));
    const step = STEPS.find((each) => span / each <= lines) ?? STEPS.at(-1);
    const low = Math.floor(bottom / step) * step, high = Math.ceil((bottom + span) / step) * step;
    const y = (value) => height - 8 - ((value - low) / (high - low)) * (height - 24);
    pen.font = "16px system-ui, sans-serif";
    pen.lineWidth = 1;
    for (let value = low; value <= high; value += step) {
      pen.strokeStyle = "#30363d";
      pen.beginPath();
      pen.moveTo(56, y(value));
      pen.lineTo(width, y(value));
      pen.stroke();
      pen.fillStyle = "#a9b4c0";
      pen.fillText(String(value), 4, y(value) + 5);
    }
    pen.strokeStyle = "#5ab0ff";
    pen.lineWidth = 2;
    pen.beginPath();
    let drawn = false;
    this.values.forEach((value, index) => {
      if (value === null) { drawn = false; return; }
      const x = 56 + ((width - 60) * index) / (KEPT - 1);
      if (drawn) pen.lineTo(x, y(value));
      else pen.moveTo(x, y(value));
      drawn = true;
    });
    pen.stroke();
  }
}
