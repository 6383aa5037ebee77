// The page of replays: start from a recording, progress, and the resulting reports, videos and models.

import { call, download, fetched, useTicket } from "./api.js";
import { confirmed } from "./dialogs.js";
import { chosenOptions, offerOptions } from "./options.js";
import { button, replaceRows, row } from "./table.js";
import { when } from "./times.js";

const at = (id) => document.getElementById(id);
const OPEN = ["queued", "running"];
const MOST_WATCHED = 8;

/** Return `renew`, which refreshes the page, and `choose(name)`, which selects a recording in its form. */
export function replaysPage(report) {
  let shown = [];
  let asked = 0, current = 0; // number of list requests, and the first request whose result includes the chosen recording
  const watched = new Map();

  async function renew() {
    const number = ++asked;
    await offerOptions(at("replay-options"), "ReplayRequest");
    const [recordings, replays] = await Promise.all([call("GET", "/v1/recordings"), call("GET", "/v1/replays?count=50")]);
    if (number >= current) offer(recordings.filter((each) => each.state === "ready").map((each) => each.name));
    shown = replays;
    draw();
    const open = shown.filter((each) => OPEN.includes(each.state)).slice(-MOST_WATCHED);
    await Promise.all(open.map((each) => watch(each.id)));
  }

  function offer(names) {
    const choice = at("replay-recording"), chosen = choice.value;
    if ([...choice.options].map((option) => option.value).join() === names.join()) return;
    choice.replaceChildren(...names.map((name) => new Option(name, name)));
    if (names.includes(chosen)) choice.value = chosen;
  }

  function draw() {
    replaceRows(at("replay-rows"), shown.map(line));
  }

  /** Follow a replay until it ends or the connection closes; opening the page again resumes it. */
  async function watch(id) {
    if (watched.has(id)) return;
    watched.set(id, null);
    const path = `/v1/replays/${id}/progress`;
    try {
      const socket = new WebSocket(`${location.protocol === "https:" ? "wss:" : "ws:"}//${location.host}${await useTicket(path)}`);
      watched.set(id, socket);
      socket.onmessage = (message) => {
        const now = JSON.parse(message.data);
        shown = shown.map((each) => (each.id === id ? now : each));
        draw();
      };
      socket.onclose = () => watched.delete(id);
    } catch (error) {
      watched.delete(id);
      throw error;
    }
  }

  function line(replay) {
    const path = `/v1/replays/${replay.id}`;
    const then = (act) => async () => { await act(); await renew(); };
    const actions = [];
    if (OPEN.includes(replay.state)) actions.push(button("Cancel", then(() => call("POST", `${path}/cancel`)), report));
    else {
      const has = (name) => replay.results.includes(name);
      if (has("report.html")) actions.push(button("Report", () => openReport(`${path}/results/report.html`), report));
      if (has("reconstruction.mp4")) actions.push(button("Video", () => play(replay), report));
      if (has("model.isplat")) {
        actions.push(button("Keep model", () => keep(replay), report));
        actions.push(button("Download", () => download(`${path}/results/model.isplat`), report));
      }
      actions.push(button("Delete", async () => {
        const sure = await confirmed({
          title: `Delete the replay ${replay.id}?`,
          what: `Replay ${replay.id} of the recording ${replay.recording}, ${replay.state}, with ${replay.results.join(", ") || "no results"}`,
          consequence: "Its report, video and model are deleted. The recording, and a model stored in the registry, are kept. This cannot be undone.",
        });
        if (sure) await then(() => call("DELETE", path))();
      }, report, `Delete the replay ${replay.id}`));
    }
    const options = Object.entries(replay.options).map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`).join(", ");
    const state = replay.reason ? `${replay.state}: ${replay.reason}` : replay.state;
    const decibels = (value) => (Number.isFinite(value) ? value.toFixed(1) : "");
    const figures = [replay.psnr_db, replay.previous_frame_db, replay.next_frame_db].map(decibels);
    const started = [when(replay.created_at), `, ${replay.created_by}`];
    return row(replay.recording, replay.id, state, progress(replay), ...figures, options, started, actions);
  }

  /** Open a report in a new tab. The server sandboxes it by its content security policy. */
  async function openReport(path) {
    window.open(await useTicket(path), "_blank", "noopener");
  }

  async function play(replay) {
    const player = at("replay-video");
    URL.revokeObjectURL(player.src);
    player.src = URL.createObjectURL(await (await fetched(`/v1/replays/${replay.id}/results/reconstruction.mp4`)).blob());
    at("replay-player-name").textContent = `${replay.recording}: camera and reconstruction`;
    at("replay-player").hidden = false;
    player.focus();
  }

  async function keep(replay) {
    const dialog = at("keep-model");
    at("keep-name").value = replay.recording;
    dialog.returnValue = "";
    dialog.showModal();
    await new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
    if (dialog.returnValue !== "keep") return;
    const made = await call("POST", `/v1/replays/${replay.id}/keep`, { model: at("keep-name").value });
    at("replay-said").value = `${made.name}/${made.version} is in the registry and is being checked`;
  }

  at("start-replay").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const wanted = { recording: at("replay-recording").value, options: chosenOptions(at("replay-options")) };
      await call("POST", "/v1/replays", wanted, { "Idempotency-Key": idempotencyKey() });
      await renew();
    });
  });

  /** Select a recording in the form immediately. Results of earlier list requests may lack it and do not change the form. */
  function choose(name) {
    const choice = at("replay-recording");
    if (![...choice.options].some((option) => option.value === name)) choice.add(new Option(name, name));
    choice.value = name;
    current = asked + 1;
  }

  return { renew, choose };
}

function idempotencyKey() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

function progress({ state, frames, frames_done }) {
  if (!frames) return state === "running" ? "starting" : "";
  const bar = document.createElement("progress");
  bar.max = frames;
  bar.value = frames_done;
  bar.setAttribute("aria-label", "Progress");
  return [bar, ` ${frames_done} of ${frames} frames`];
}
