// The page of streams: made, started, stopped, and how their processes are.

import { call } from "./api.js";
import { button, replaceRows, row } from "./table.js";

const at = (id) => document.getElementById(id);

/** Returns what renews the page and the choice of a stream. */
export function streamsPage(report, onStreams) {
  async function renew() {
    const streams = await call("GET", "/v1/streams");
    onStreams(streams);
    replaceRows(at("stream-rows"), streams.map(line));
  }

  function line(stream) {
    const path = `/v1/streams/${stream.name}`;
    const then = (act) => async () => { await act(); await renew(); };
    const runs = stream.state !== "stopped";
    const actions = [
      runs ? button("Stop", then(() => call("POST", `${path}/stop`)), report) : button("Start", then(() => call("POST", `${path}/start`)), report),
      button("Delete", then(() => call("DELETE", path)), report),
    ];
    const state = stream.reason ? `${stream.state}: ${stream.reason}` : stream.state;
    return row(stream.name, stream.source, stream.show, state, process(stream.processes.capture), process(stream.processes.engine), actions);
  }

  at("new-stream").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const wanted = { name: at("stream-name").value, source: at("stream-source").value, show: at("stream-show").value };
      await call("POST", "/v1/streams", wanted);
      await renew();
    });
  });

  return renew;
}

function process(said) {
  if (!said) return "";
  return [said.state, said.restarts ? `${said.restarts} restarts` : "", said.reason ?? ""].filter(Boolean).join(", ");
}
