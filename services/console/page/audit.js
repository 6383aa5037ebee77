// The audit log page: entries in reverse order with a filter, and export to a file.

import { call, download } from "./api.js";
import { long, row } from "./table.js";
import { when } from "./times.js";

const at = (id) => document.getElementById(id);
const COUNT = 50;
const FIELDS = ["event", "actor", "subject", "outcome"];

/** Return a function that refreshes the page. */
export function auditPage(report) {
  let before = null;
  let wanted = new URLSearchParams();

  async function renew() {
    at("entries").replaceChildren();
    before = null;
    wanted = chosen();
    at("audit-said").value = "";
    await older();
  }

  /** Append the next entries. A filtered page may be empty although more entries exist, because each request searches a part of the log. */
  async function older() {
    let found = 0;
    do {
      const query = new URLSearchParams(wanted);
      query.set("count", String(COUNT));
      if (before !== null) query.set("before", String(before));
      const page = await call("GET", `/v1/audit?${query}`);
      at("entries").append(...page.entries.map(line));
      found += page.entries.length;
      before = page.next_before;
    } while (found === 0 && before !== null);
    at("older").hidden = before === null;
    at("audit-said").value = at("entries").childElementCount ? "" : "no matching entries";
  }

  at("older").addEventListener("click", () => report(older));
  at("audit-filter").addEventListener("submit", (event) => {
    event.preventDefault();
    report(renew);
  });
  at("audit-filter").addEventListener("reset", () => setTimeout(() => report(renew))); // after the browser has cleared the fields
  for (const form of ["csv", "jsonl"]) {
    at(`save-${form}`).addEventListener("click", () => report(() => download(`/v1/audit/export?${new URLSearchParams([...chosen(), ["format", form]])}`)));
  }
  return renew;
}

/** Return the form's query. Its times are in the browser's time zone and are converted to UTC. */
function chosen() {
  const query = new URLSearchParams();
  for (const field of FIELDS) {
    const value = at(`audit-${field}`).value.trim();
    if (value) query.set(field, value);
  }
  for (const bound of ["since", "until"]) {
    const value = at(`audit-${bound}`).value;
    if (value) query.set(bound, new Date(value).toISOString());
  }
  return query;
}

function line(entry) {
  const actor = entry.role ? `${entry.actor}, ${entry.role}` : entry.actor;
  const detail = Object.entries(entry.detail).map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`).join(", ");
  return row(entry.seq, when(entry.at), entry.event, actor, entry.subject, entry.outcome, long(detail), entry.request_id);
}
