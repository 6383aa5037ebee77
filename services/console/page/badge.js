// State and age of one image, displayed next to it. An image whose connection is lost must not look live.

const SILENT_MS = 1500;

/** Writes the state to an element. Call `say(header)` for each image, and `lost()` when the connection is lost. */
export class Badge {
  constructor(place) {
    Object.assign(this, { place, heard_ms: performance.now(), state: "", timer: setInterval(() => this.look(), 250) });
    place.classList.add("badge");
    this.write("no picture");
  }

  say(header) {
    this.heard_ms = performance.now();
    this.write(header.state, header.age_ms);
  }

  lost() {
    this.write("no connection");
  }

  look() {
    const silent_ms = performance.now() - this.heard_ms;
    if (silent_ms > SILENT_MS && this.state !== "no connection") this.write("no picture", silent_ms);
  }

  write(state, age_ms) {
    this.state = state;
    if (this.place.dataset.state !== state) this.place.dataset.state = state;
    const age = Number.isFinite(age_ms) ? (age_ms < 1000 ? ` ${Math.round(age_ms)} ms` : ` ${(age_ms / 1000).toFixed(1)} s`) : "";
    this.place.textContent = state + age;
  }

  close() {
    clearInterval(this.timer);
  }
}
