// The page of models: upload, activate, roll back, delete.

import { call, upload } from "./api.js";
import { confirmed } from "./dialogs.js";
import { exportControls } from "./exports.js";
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
      actions.push(...exportControls(`${path}/versions/${version.version}`, `${model.name} ${version.version}`, report));
    }
    const state = version.reason ? `${version.state}: ${version.reason}` : version.state;
    const uploaded = [when(version.uploaded_at), `, ${version.uploaded_by}`];
    return row(model.name, version.version, digest(version.digest), state, size(version.size_bytes), uploaded, actions);
  }

  at("upload").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const bar = at("uploaded"), file = at("model-file").files[0];
      bar.value = 0;
      bar.hidden = false;
      try {
        const made = await upload(`/v1/models/${at("model-name").value}/versions`, file, (share) => { bar.value = share; });
        await checked(made);
      } finally {
        bar.hidden = true;
        await renew();
      }
    });
  });

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
