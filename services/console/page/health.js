// The health page: checks of /readyz, versions, and the streams with their processes.

import { call } from "./api.js";
import { replaceRows, row } from "./table.js";
import { processFacts } from "./streams.js";

const at = (id) => document.getElementById(id);

/** Return a function that refreshes the page. */
export function healthPage() {
  return async function renew() {
    const [ready, version, streams] = await Promise.all([readiness(), call("GET", "/v1/version"), call("GET", "/v1/streams")]);
    at("health-status").textContent = ready.status;
    at("health-status").dataset.status = ready.status;
    replaceRows(at("health-checks"), Object.entries(ready.checks ?? {}).map(check));
    const facts = Object.entries(version).map(([name, value]) => [name, Array.isArray(value) ? value.join(", ") : String(value)]);
    at("health-versions").replaceChildren(...facts.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
    replaceRows(at("health-streams"), streams.map((stream) => row(
      stream.name, stream.reason ? `${stream.state}: ${stream.reason}` : stream.state,
      processFacts(stream.processes.capture), processFacts(stream.processes.engine),
    )));
  };
}

/** Fetch /readyz, which also has a body with status 503 and requires no key. */
async function readiness() {
  const answer = await fetch("/readyz?verbose");
  if (answer.ok || answer.status === 503) return answer.json();
  throw new Error(`/readyz answers ${answer.status}`);
}

function check([name, { ok, detail, needed }]) {
  const state = element("span", ok ? "ok" : needed ? "failed, required" : "failed");
  state.className = `check ${ok ? "well" : needed ? "failed" : "degraded"}`;
  return row(name.replaceAll("_", " "), [state], detail ?? "");
}

function element(tag, text) {
  return Object.assign(document.createElement(tag), { textContent: text });
}
