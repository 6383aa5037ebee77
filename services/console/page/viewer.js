// Displays a stream's images from its WebSocket on a canvas. A closed connection is reopened.

import { call } from "./api.js";

const AGAIN_MS = [250, 500, 1000, 2000, 4000];

/** Shows one kind of image (`raw`, `shown` or a layer) of a stream until `close` is called. */
export class Viewer {
  /** onPicture(header) is called for each drawn image, and onLost() when the connection is lost. */
  constructor(stream, kind, canvas, { onPicture, onLost }) {
    Object.assign(this, { stream, kind, canvas, onPicture, onLost, closed: false, attempt: 0, socket: null, waiting: null, drawing: false });
    this.connect();
  }

  async connect() {
    const path = `/v1/streams/${this.stream}/display`;
    try {
      const { ticket } = await call("POST", "/v1/tickets", { path });
      if (this.closed) return;
      const scheme = location.protocol === "https:" ? "wss:" : "ws:";
      this.socket = new WebSocket(`${scheme}//${location.host}${path}?kind=${this.kind}&ticket=${encodeURIComponent(ticket)}`);
      this.socket.binaryType = "arraybuffer";
      this.socket.onmessage = (message) => { this.attempt = 0; this.take(message.data); };
      this.socket.onclose = () => this.again();
    } catch {
      this.again(); // the state shows the failure; the next attempt may succeed
    }
  }

  again() {
    if (this.closed) return;
    this.onLost();
    const wait_ms = AGAIN_MS[Math.min(this.attempt++, AGAIN_MS.length - 1)];
    setTimeout(() => { if (!this.closed) this.connect(); }, wait_ms);
  }

  /** Draw a message. While one is being drawn, only the newest further message is kept. */
  async take(message) {
    this.waiting = message;
    if (this.drawing) return;
    this.drawing = true;
    try {
      while (this.waiting && !this.closed) {
        const newest = this.waiting;
        this.waiting = null;
        await this.draw(newest);
      }
    } finally {
      this.drawing = false;
    }
  }

  async draw(message) {
    const length = new DataView(message).getUint32(0);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
    const picture = await createImageBitmap(new Blob([new Uint8Array(message, 4 + length)], { type: "image/jpeg" }));
    if (this.closed) return;
    if (this.canvas.width !== picture.width || this.canvas.height !== picture.height) {
      this.canvas.width = picture.width;
      this.canvas.height = picture.height;
    }
    this.canvas.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
    this.onPicture(header);
  }

  close() {
    this.closed = true;
    this.socket?.close();
  }
}
