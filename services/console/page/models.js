// The page of models: upload, activate, roll back, delete.

import { call, posted, upload } from "./api.js";
import { confirmed } from "./dialogs.js";
import { exportControls } from "./exports.js";
import { chosenOptions, offerOptions } from "./options.js";
import { button, digest, replaceRows, row, size } from "./table.js";
import { when } from "./times.js";

const at = (id) => document.getElementById(id);

/** Return a function that refreshes the page. `report(act)` runs an async function and shows its errors. */
export function modelsPage(report) {
  async function renew() {
    const models = await call("GET", "/v1/models");
    const rows = [];
    for (const model of models) {
      const versions = await call("GET", `/v1/models/${model.name}/versions`);
      for (const version of versions.sort((a, b) => b.version - a.version)) rows.push(line(model, version));
    }
    replaceRows(at("versions"), rows);
  }

  function line(model, version) {
    const path = `/v1/models/${model.name}`;
    const then = (act) => async () => { await act(); await renew(); };
    const actions = [];
    if (version.state === "ready" || version.state === "retired") {
      const body = { version: version.version, expected_current: model.active };
      actions.push(button("Activate", then(() => call("POST", `${path}/activate`, body)), report));
    }
    if (version.state === "active") actions.push(button("Roll back", then(() => call("POST", `${path}/rollback`)), report));
    else actions.push(button("Delete", async () => {
      const sure = await confirmed({
        title: `Delete version ${version.version} of the model ${model.name}?`,
        what: `Version ${model.name}/${version.version}, ${version.state}, ${size(version.size_bytes)}, SHA-256 ${version.digest.slice(0, 12)}…, uploaded by ${version.uploaded_by}`,
        consequence: "Its file is deleted, and no stream can show it or roll back to it. This cannot be undone.",
      });
      if (sure) await then(() => call("DELETE", `${path}/versions/${version.version}`))();
    }, report, `Delete version ${version.version} of the model ${model.name}`));
    if (["ready", "active", "retired"].includes(version.state)) {
      actions.push(button("Picture", () => choose(model.name, version.version), report, `Picture or video of ${model.name} ${version.version}`));
      actions.push(...exportControls(`${path}/versions/${version.version}`, `${model.name} ${version.version}`, report));
    }
    const state = version.reason ? `${version.state}: ${version.reason}` : version.state;
    const uploaded = [when(version.uploaded_at), `, ${version.uploaded_by}`];
    return row(model.name, version.version, digest(version.digest), state, [size(version.size_bytes), contents(version.description)], uploaded, actions);
  }

  /** Return a text of the number of Gaussians and the kind of a model; empty before the model is checked. */
  function contents({ gaussians, field, renderer }) {
    if (gaussians === undefined) return "";
    const kind = field ? `moving (${field})` : "static";
    return `, ${gaussians.toLocaleString("en")} Gaussians, ${kind}${renderer && renderer !== "alpha" ? `, ${renderer}` : ""}`;
  }

  at("upload").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const bar = at("uploaded"), file = at("model-file").files[0];
      bar.value = 0;
      bar.hidden = false;
      try {
        const format = /\.(ply|splat|spz)$/i.exec(file.name)?.[1].toLowerCase();
        const path = `/v1/models/${at("model-name").value}/versions${format ? `?format=${format}` : ""}`;
        const made = await upload(path, file, (share) => { bar.value = share; });
        await checked(made);
      } finally {
        bar.hidden = true;
        await renew();
      }
    });
  });

  let chosen = { path: "", file: "" }, address = "";

  /** Open the form that renders a version. */
  async function choose(name, version) {
    await offerOptions(at("render-options"), "RenderRequest");
    chosen = { path: `/v1/models/${name}/versions/${version}/render`, file: `${name}-${version}` };
    at("render-name").textContent = `${name}/${version}`;
    at("render").hidden = false;
    at("render").scrollIntoView({ block: "nearest" });
  }

  at("render-form").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const format = at("render-format").value, time = at("render-time").value;
      const wanted = { format, view: at("render-view").value, options: chosenOptions(at("render-options")) };
      if (time !== "" && format === "png") wanted.time_s = Number(time);
      at("render-said").value = "rendering";
      try {
        show(format, await (await posted(chosen.path, wanted)).blob());
      } finally {
        at("render-said").value = "";
      }
    });
  });

  function show(format, file) {
    if (address) URL.revokeObjectURL(address);
    address = URL.createObjectURL(file);
    const picture = at("render-picture"), video = at("render-video"), save = at("render-save");
    picture.hidden = format !== "png";
    video.hidden = format !== "mp4";
    if (format === "png") picture.src = address;
    else video.src = address;
    Object.assign(save, { href: address, download: `${chosen.file}.${format}`, hidden: false });
  }

  /** Wait until the server has checked a version. Throws if it is rejected. */
  async function checked({ name, version }) {
    for (let wait_ms = 200; ; wait_ms = Math.min(2 * wait_ms, 2000)) {
      await renew();
      const now = await call("GET", `/v1/models/${name}/versions/${version}`);
      if (now.state === "rejected") throw new Error(`${name}/${version} was rejected: ${now.reason}`);
      if (now.state !== "uploaded" && now.state !== "validated") return;
      await new Promise((resolve) => setTimeout(resolve, wait_ms));
    }
  }

  return renew;
}
