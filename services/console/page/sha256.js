// Incremental SHA-256 of a file. crypto.subtle.digest requires the whole file in memory and a secure context.

const MOST_AT_ONCE = 64 * 2 ** 20;
const K = new Uint32Array(64), START = new Uint32Array(8);

/** Constants of FIPS 180-4: the first 32 fractional bits of the square and cube roots of the first primes. */
(() => {
  const bits = (x) => Math.floor((x - Math.floor(x)) * 2 ** 32);
  for (let n = 2, found = 0; found < 64; n += 1) {
    let prime = true;
    for (let d = 2; d * d <= n; d += 1) if (n % d === 0) { prime = false; break; }
    if (!prime) continue;
    if (found < 8) START[found] = bits(Math.sqrt(n));
    K[found] = bits(Math.cbrt(n));
    found += 1;
  }
})();

/** Incremental hash. */
export class Sha256 {
  constructor() {
    Object.assign(this, { state: START.slice(), block: new Uint8Array(64), filled: 0, length: 0, words: new Uint32Array(64) });
  }

  add(bytes) {
    this.length += bytes.length;
    let at = 0;
    if (this.filled > 0) {
      at = Math.min(64 - this.filled, bytes.length);
      this.block.set(bytes.subarray(0, at), this.filled);
      this.filled += at;
      if (this.filled < 64) return;
      this.mix(this.block, 0);
      this.filled = 0;
    }
    for (; at + 64 <= bytes.length; at += 64) this.mix(bytes, at);
    this.block.set(bytes.subarray(at), 0);
    this.filled = bytes.length - at;
  }

  /** Return the digest of all added bytes. No more bytes may be added. */
  digest() {
    const bits = this.length * 8;
    const tail = new Uint8Array(this.filled < 56 ? 64 - this.filled : 128 - this.filled);
    const view = new DataView(tail.buffer);
    tail[0] = 0x80;
    view.setUint32(tail.length - 8, Math.floor(bits / 2 ** 32));
    view.setUint32(tail.length - 4, bits >>> 0);
    this.add(tail);
    const found = new DataView(new ArrayBuffer(32));
    this.state.forEach((word, index) => found.setUint32(4 * index, word));
    return new Uint8Array(found.buffer);
  }

  mix(bytes, at) {
    const w = this.words, s = this.state;
    for (let i = 0, from = at; i < 16; i += 1, from += 4) {
      w[i] = (bytes[from] << 24) | (bytes[from + 1] << 16) | (bytes[from + 2] << 8) | bytes[from + 3];
    }
    for (let i = 16; i < 64; i += 1) {
      const x = w[i - 15], y = w[i - 2];
      const low = ((x >>> 7) | (x << 25)) ^ ((x >>> 18) | (x << 14)) ^ (x >>> 3);
      const high = ((y >>> 17) | (y << 15)) ^ ((y >>> 19) | (y << 13)) ^ (y >>> 10);
      w[i] = (w[i - 16] + low + w[i - 7] + high) | 0;
    }
    let [a, b, c, d, e, f, g, h] = s;
    for (let i = 0; i < 64; i += 1) {
      const turned = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
      const first = (h + turned + ((e & f) ^ (~e & g)) + K[i] + w[i]) | 0;
      const rolled = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
      const second = (rolled + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      h = g; g = f; f = e; e = (d + first) | 0; d = c; c = b; b = a; a = (first + second) | 0;
    }
    s[0] += a; s[1] += b; s[2] += c; s[3] += d; s[4] += e; s[5] += f; s[6] += g; s[7] += h;
  }
}

/** Return the SHA-256 of a file in base64; `progress(share)` is called during the computation. */
export async function sha256(file, progress = () => {}) {
  if (file.size <= MOST_AT_ONCE && globalThis.crypto?.subtle) {
    return base64(new Uint8Array(await crypto.subtle.digest("SHA-256", await file.arrayBuffer())));
  }
  const running = new Sha256(), reader = file.stream().getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return base64(running.digest());
    running.add(value);
    progress(running.length / file.size);
  }
}

function base64(bytes) {
  return btoa(String.fromCharCode(...bytes));
}
