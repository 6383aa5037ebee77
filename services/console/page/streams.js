// The page of streams: create, start, stop, and the state of their processes.

import { call } from "./api.js";
import { confirmed } from "./dialogs.js";
import { chosenOptions, offerOptions } from "./options.js";
import { button, long, replaceRows, row } from "./table.js";
import { age } from "./times.js";

const at = (id) => document.getElementById(id);

/** Return a function that refreshes the page and the stream selection. */
export function streamsPage(report, onStreams) {
  async function renew() {
    const streams = await call("GET", "/v1/streams");
    onStreams(streams);
    replaceRows(at("stream-rows"), streams.map(line));
    await offerOptions(at("stream-options"), "StreamRequest");
  }

  function line(stream) {
    const path = `/v1/streams/${stream.name}`;
    const then = (act) => async () => { await act(); await renew(); };
    const asked = (question, act) => async () => { if (await confirmed(question)) await then(act)(); };
    const what = `Stream ${stream.name}, source ${stream.source}, ${stream.state}, viewers: ${watching(stream) || "none"}`;
    const stop = {
      title: `Stop the stream ${stream.name}?`, what, verb: "Stop",
      consequence: "All viewers lose its images, including the camera image. The live reconstruction is lost unless a snapshot was taken.",
    };
    const remove = {
      title: `Delete the stream ${stream.name}?`, what,
      consequence: "The stream is stopped and its settings are deleted. The live reconstruction is lost unless a snapshot was taken. This cannot be undone.",
    };
    const runs = stream.state !== "stopped";
    const actions = [
      runs ? button("Stop", asked(stop, () => call("POST", `${path}/stop`)), report, `Stop the stream ${stream.name}`)
        : button("Start", then(() => call("POST", `${path}/start`)), report, `Start the stream ${stream.name}`),
      button("Delete", asked(remove, () => call("DELETE", path)), report, `Delete the stream ${stream.name}`),
    ];
    const { capture, engine } = stream.processes;
    const picture = engine?.figures?.picture ?? {};
    return row(
      stream.name, long(stream.source), stream.show, stream.reason ? `${stream.state}: ${stream.reason}` : stream.state,
      processFacts(capture), processFacts(engine), age(picture.age_ms), quality(picture), watching(stream), actions,
    );
  }

  at("new-stream").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const options = chosenOptions(at("stream-options"));
      const wanted = { name: at("stream-name").value, source: at("stream-source").value, show: at("stream-show").value, options };
      await call("POST", "/v1/streams", wanted);
      await renew();
    });
  });

  return renew;
}

/** Return the cell text of a process: its state, rate, restarts, and the reason of a failure. */
export function processFacts(process) {
  if (!process) return "";
  const said = [process.state];
  if (Number.isFinite(process.rate_hz)) said.push(`${process.rate_hz.toFixed(1)} frames/s`);
  said.push(process.restarts === 1 ? "1 restart" : `${process.restarts ?? 0} restarts`);
  if (process.pid) said.push(`process ${process.pid}`);
  if (process.reason && !["live", "running"].includes(process.state)) said.push(process.reason);
  return said.join(", ");
}

/** Return the PSNR of an image header, then that of the trivial predictors if the server sends them; "" without a PSNR. */
export function quality(report) {
  const decibels = (value) => (Number.isFinite(value) ? value.toFixed(1) : "");
  const own = decibels(report.psnr_db);
  if (!own) return "";
  const previous = decibels(report.previous_frame_db);
  const next = decibels(report.next_frame_db);
  const beside = [previous && `previous frame ${previous}`, next && `next frame ${next}`].filter(Boolean).join(", ");
  return beside ? `${own} (${beside})` : own;
}

function watching({ viewers }) {
  const open = Object.entries(viewers ?? {}).filter(([, count]) => count > 0);
  return open.map(([kind, count]) => `${count} ${kind}`).join(", ");
}
