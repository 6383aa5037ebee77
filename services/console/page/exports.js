// Downloads: snapshots of a stream and exports of models.

import { call, download } from "./api.js";
import { button, size } from "./table.js";
import { when } from "./times.js";

const FORMATS = {
  isplat: "IntraSplat model (.isplat)",
  ply: "Gaussians (.ply)",
  "compressed-ply": "Gaussians, compressed (.compressed.ply)",
  splat: "Gaussians (.splat)",
  spz: "Gaussians, compressed (.spz)",
  glb: "glTF (.glb)",
  "ply-sequence": "over time (.zip)",
  "mesh-glb": "surface, glTF (.glb)",
  "mesh-ply": "surface (.ply)",
  "points-ply": "surface points (.ply)",
};

/** Create the controls to save an object in a chosen format; `path` is the URL before `/exports/FORMAT`. */
export function exportControls(path, name, report) {
  const choice = document.createElement("select");
  choice.setAttribute("aria-label", `Format to save ${name} in`);
  choice.append(...Object.entries(FORMATS).map(([format, text]) => new Option(text, format)));
  return [choice, button("Save", () => download(`${path}/exports/${choice.value}`), report)];
}

/** Create the snapshot controls in `place`. Returns `watch(stream)`, which selects the stream. */
export function snapshotsOf(place, report) {
  let stream = "";
  const name = document.createElement("input");
  Object.assign(name, { id: "snapshot-model", placeholder: "none: store as a file", pattern: "[a-z0-9][a-z0-9\\-]{0,39}", autocomplete: "off" });
  const label = document.createElement("label");
  label.append("Store as a version of model ", name);
  const said = document.createElement("p");
  said.className = "said";
  said.setAttribute("role", "status");
  const list = document.createElement("ul");
  list.className = "files";
  const kept = document.createElement("details"), title = document.createElement("summary");
  kept.append(title, list);
  kept.hidden = true;
  const take = button("Take a snapshot", async () => {
    if (!name.reportValidity()) return;
    const key = crypto.randomUUID?.() ?? String(performance.now());
    const taken = await call("POST", `/v1/streams/${stream}/snapshots`, name.value ? { model: name.value } : {}, { "Idempotency-Key": key });
    const what = taken.version ? `version ${taken.version.version} of ${taken.version.name}` : "stored as a file, listed below";
    said.textContent = `Frame ${taken.seq}, ${taken.gaussians} Gaussians: ${what}. Training paused for ${taken.pause_ms.toFixed(1)} ms.`;
    if (taken.version) said.textContent += ` It is ${await checked(taken.version)}.`;
    await renew();
    kept.open = !taken.version;
  }, report);
  take.id = "take-snapshot";
  const row = document.createElement("div");
  row.className = "row";
  row.append(take, label);
  place.append(row, said, kept);

  /** Wait for the server to check a new version, and return its state. */
  async function checked({ name: model, version }) {
    for (let wait_ms = 200; ; wait_ms = Math.min(2 * wait_ms, 2000)) {
      const now = await call("GET", `/v1/models/${model}/versions/${version}`);
      if (now.state !== "uploaded" && now.state !== "validated") return now.reason ? `${now.state}: ${now.reason}` : now.state;
      await new Promise((resolve) => setTimeout(resolve, wait_ms));
    }
  }

  async function renew() {
    const found = stream ? await call("GET", `/v1/streams/${stream}/snapshots`) : [];
    title.textContent = `Stored snapshots: ${found.length}`;
    kept.hidden = found.length === 0;
    list.replaceChildren(...found.slice(0, 5).map((snapshot) => {
      const line = document.createElement("li");
      const text = document.createElement("span");
      text.append(`${snapshot.id}, `, when(snapshot.taken_at), `, frame ${snapshot.seq}, ${size(snapshot.size_bytes)}`);
      line.append(text, ...exportControls(`/v1/streams/${stream}/snapshots/${snapshot.id}`, `the snapshot of frame ${snapshot.seq}`, report));
      return line;
    }));
  }

  return (wanted) => {
    stream = wanted;
    place.hidden = !stream;
    kept.open = false;
    said.textContent = "";
    if (stream) report(renew);
  };
}
