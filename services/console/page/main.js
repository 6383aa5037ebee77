// The console: page navigation, stream selection, and the state of the live images.

import { call, setKeyDialog, signOut, useKey } from "./api.js";
import { auditPage } from "./audit.js";
import { Badge } from "./badge.js";
import { snapshotsOf } from "./exports.js";
import { healthPage } from "./health.js";
import { keysPage } from "./keys.js";
import { layersOf } from "./layers.js";
import { modelsPage } from "./models.js";
import { Plot } from "./plot.js";
import { recordingsPage } from "./recordings.js";
import { replaysPage } from "./replays.js";
import { quality, streamsPage } from "./streams.js";
import { age } from "./times.js";
import { Viewer } from "./viewer.js";

const at = (id) => document.getElementById(id);
const SILENT_MS = 1500;
const RENEW_MS = 2000;

const plots = { age: new Plot(at("age")), psnr: new Plot(at("psnr"), { from_zero: false }) };
const badges = { raw: new Badge(at("raw-state")), shown: new Badge(at("shown-state")) };
const watchLayers = layersOf(at("layers"), at("pictures"), report);
const watchSnapshots = snapshotsOf(at("snapshots"), report);
let viewers = [];
let watched = "";
let heard_ms = 0;

/** Run an action of the user; an error is shown until the next action. */
async function report(act) {
  at("problem").hidden = true;
  await quietly(act);
}

/** Run an action and show its error. Unlike `report`, it does not clear an earlier error message. */
async function quietly(act) {
  try {
    await act();
  } catch (error) {
    at("problem").textContent = error.message;
    at("problem").hidden = false;
  }
}

function say(state, age_ms) {
  const place = at("state");
  if (place.dataset.state !== state) { // only on change, because screen readers announce it
    place.dataset.state = state;
    place.firstElementChild.textContent = state;
  }
  place.lastElementChild.textContent = Number.isFinite(age_ms) ? ` ${age(age_ms)}` : "";
}

function watch(stream) {
  if (stream === watched) return;
  watched = stream;
  viewers.forEach((viewer) => viewer.close());
  viewers = [];
  plots.age.clear();
  plots.psnr.clear();
  say("no picture");
  watchLayers(stream);
  watchSnapshots(stream);
  if (!stream) return;
  const lost = () => { say("no connection"); badges.shown.lost(); };
  viewers = [
    new Viewer(stream, "raw", at("raw"), { onPicture: raw, onLost: () => badges.raw.lost() }),
    new Viewer(stream, "shown", at("shown"), { onPicture: shown, onLost: lost }),
  ];
}

function raw(header) {
  badges.raw.say(header);
  at("raw-facts").value = `frame ${header.seq}`;
}

function shown(header) {
  heard_ms = performance.now();
  badges.shown.say(header);
  say(header.state, header.age_ms);
  at("shown-facts").value = `frame ${header.seq}, model ${header.model_version ?? "–"}`;
  if (header.new === false) return;
  plots.age.add(header.age_ms);
  plots.psnr.add(header.psnr_db ?? null);
  at("age-now").value = header.age_ms.toFixed(0);
  at("psnr-now").value = quality(header);
}

/** Show "no picture" and its duration if no image has arrived for SILENT_MS, so that an outdated state does not look current. */
setInterval(() => {
  if (watched && heard_ms && performance.now() - heard_ms > SILENT_MS && at("state").dataset.state !== "no connection") {
    say("no picture", performance.now() - heard_ms);
  }
}, 250);

function chooseAmong(streams) {
  const choice = at("stream");
  const names = streams.map((stream) => stream.name);
  if ([...choice.options].map((option) => option.value).join() !== names.join()) {
    const chosen = choice.value;
    choice.replaceChildren(...names.map((name) => new Option(name, name)));
    if (names.includes(chosen)) choice.value = chosen;
  }
  watch(choice.value);
  explain(streams.find((stream) => stream.name === choice.value));
}

/** Show the state of a stream and the server's reason for it, for example that a check withholds frames; hide it without a reason. */
function explain(stream) {
  const reason = stream?.reason && stream.state !== "stopped" ? `${stream.state}: ${stream.reason}` : "";
  if (at("stream-reason").textContent !== reason) at("stream-reason").textContent = reason; // screen readers announce a change
  at("stream-reason").hidden = !reason;
}

let myself = null;
/** Permission that each page requires; pages without permission are hidden. */
const NEEDS = { models: "everything", recordings: "everything", replays: "everything", keys: "admin", audit: "admin" };

/** Show the name and role of the key in use, and the pages that it may access. */
async function renewAccount() {
  myself = await call("GET", "/v1/me");
  const limits = [myself.streams && `only ${myself.streams.join(", ")}`, myself.expires_at && `until ${new Date(myself.expires_at).toLocaleDateString()}`];
  at("account-name").textContent = myself.name;
  at("account-role").textContent = [`role ${myself.role}`, ...limits].filter(Boolean).join(", ");
  at("account-name").title = `key ${myself.key_id}`;
  at("account").hidden = false;
  for (const [page, need] of Object.entries(NEEDS)) {
    at(`tab-${page}`).hidden = need === "admin" ? myself.role !== "admin" : myself.streams !== null;
    if (at(`tab-${page}`).hidden && !at(page).hidden) open("live");
  }
}

const replays = replaysPage(report);

/** Open the replay page with a recording selected, before its list has loaded. */
function replay(name) {
  replays.choose(name);
  const opened = open("replays");
  at("replay-recording").focus();
  return opened;
}

const pages = {
  live: async () => {},
  models: modelsPage(report),
  recordings: recordingsPage(report, replay),
  replays: replays.renew,
  streams: streamsPage(report, chooseAmong),
  keys: keysPage(report, () => myself?.key_id),
  audit: auditPage(report),
  health: healthPage(),
};

function open(page) {
  for (const name of Object.keys(pages)) {
    const chosen = name === page;
    at(name).hidden = !chosen;
    at(`tab-${name}`).setAttribute("aria-selected", String(chosen));
    at(`tab-${name}`).tabIndex = chosen ? 0 : -1;
  }
  document.body.dataset.page = page;
  return report(pages[page]);
}

const tabs = [...document.querySelectorAll("[role=tab]")];
tabs.forEach((tab, index) => {
  tab.addEventListener("click", () => open(tab.getAttribute("aria-controls")));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    let next = tabs[index];
    do next = tabs[(tabs.indexOf(next) + step + tabs.length) % tabs.length]; while (next.hidden);
    next.focus();
    next.click();
  });
});

setKeyDialog((reason) => new Promise((resolve) => {
  const dialog = at("sign-in");
  if (reason) at("sign-in-reason").textContent = reason;
  dialog.addEventListener("close", () => { resolve(at("key").value); at("key").value = ""; }, { once: true });
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  if (!dialog.open) dialog.showModal();
}), () => quietly(renewAccount));
at("sign-out").addEventListener("click", signOut);

// The fragment of a URL is not sent to any server. The key is removed from the address immediately.
if (location.hash.startsWith("#key=")) {
  useKey(decodeURIComponent(location.hash.slice(5)));
  history.replaceState(null, "", location.pathname);
}

at("stream").addEventListener("change", (event) => watch(event.target.value));
await report(renewAccount);
await report(pages.streams);
setInterval(() => {
  if (document.querySelector("dialog[open]")) return;
  quietly(pages.streams);
  if (!at("health").hidden) quietly(pages.health);
}, RENEW_MS);
