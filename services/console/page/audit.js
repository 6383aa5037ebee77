// The page of the audit log, the newest entries first.

import { call } from "./api.js";
import { row } from "./table.js";

const at = (id) => document.getElementById(id);
const COUNT = 50;

/** Returns what renews the page. */
export function auditPage(report) {
  let before = null;

  async function renew() {
    at("entries").replaceChildren();
    before = null;
    await older();
  }

  async function older() {
    const page = await call("GET", `/v1/audit?count=${COUNT}${before === null ? "" : `&before=${before}`}`);
    for (const entry of page.entries) {
      at("entries").append(row(entry.seq, new Date(entry.at).toLocaleString(), entry.event, entry.role ? `${entry.actor} (${entry.role})` : entry.actor, entry.subject, entry.outcome));
    }
    before = page.next_before;
    at("older").hidden = before === null;
  }

  at("older").addEventListener("click", () => report(older));
  return renew;
}
