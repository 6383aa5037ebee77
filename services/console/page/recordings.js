// The page of recordings: upload, check results, delete.

import { call, upload } from "./api.js";
import { confirmed } from "./dialogs.js";
import { button, digest, replaceRows, row, size } from "./table.js";
import { when } from "./times.js";

const at = (id) => document.getElementById(id);

/** Return a function that refreshes the page. `replay(name)` opens the replay page for a recording. */
export function recordingsPage(report, replay) {
  async function renew() {
    replaceRows(at("recording-rows"), (await call("GET", "/v1/recordings")).map(line));
  }

  function line(recording) {
    const actions = [];
    if (recording.state === "ready") actions.push(button("Replay", async () => replay(recording.name), report));
    actions.push(button("Delete", async () => {
      const sure = await confirmed({
        title: `Delete the recording ${recording.name}?`,
        what: [`Recording ${recording.name}`, found(recording.description), size(recording.kept_bytes), `uploaded by ${recording.uploaded_by}`].filter(Boolean).join(", "),
        consequence: "The server's copy is deleted. Replays of the recording are kept. This cannot be undone.",
      });
      if (!sure) return;
      await call("DELETE", `/v1/recordings/${recording.name}`);
      await renew();
    }, report, `Delete the recording ${recording.name}`));
    const state = recording.reason ? `${recording.state}: ${recording.reason}` : recording.state;
    const uploaded = [when(recording.uploaded_at), `, ${recording.uploaded_by}`];
    return row(recording.name, digest(recording.digest), state, found(recording.description), size(recording.kept_bytes), uploaded, actions);
  }

  at("add-recording").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const bar = at("recording-sent"), name = at("recording-name").value;
      bar.value = 0;
      bar.hidden = false;
      try {
        await upload(`/v1/recordings/${name}`, at("recording-file").files[0], (share) => { bar.value = share; });
        bar.removeAttribute("value"); // upload complete; the server is checking it
        await checked(name);
      } finally {
        bar.hidden = true;
        await renew();
      }
    });
  });

  /** Wait until the server has checked a recording. Throws if it is rejected. */
  async function checked(name) {
    for (let wait_ms = 200; ; wait_ms = Math.min(2 * wait_ms, 2000)) {
      await renew();
      const now = await call("GET", `/v1/recordings/${name}`);
      if (now.state === "rejected") throw new Error(`${name} was rejected: ${now.reason}`);
      if (now.state === "ready") return;
      await new Promise((resolve) => setTimeout(resolve, wait_ms));
    }
  }

  return renew;
}

function found({ frames, width_px, height_px, fps, layout, frames_damaged, fields }) {
  if (!frames) return "";
  const said = [`${frames} frames of ${width_px}×${height_px}`, `${Number(fps.toFixed(2))} frames/s`, layout, ...fields];
  if (frames_damaged) said.push(`${frames_damaged} damaged`);
  return said.join(", ");
}
