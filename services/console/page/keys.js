// The page of API keys: create, list, revoke. For administrators only.

import { call } from "./api.js";
import { confirmed, showKey } from "./dialogs.js";
import { button, replaceRows, row } from "./table.js";
import { when } from "./times.js";

const at = (id) => document.getElementById(id);
const DAY_MS = 86_400_000;

/** Return a function that refreshes the page. `mine()` returns the id of the key in use. */
export function keysPage(report, mine) {
  async function renew() {
    replaceRows(at("key-rows"), (await call("GET", "/v1/keys")).map(line));
  }

  function line(key) {
    const own = key.id === mine();
    const streams = key.streams?.join(", ") ?? "all";
    const revoke = button("Revoke", async () => {
      const sure = await confirmed({
        title: `Revoke the key ${key.name}?`,
        what: `ID ${key.id}, ${key.role}, streams: ${streams}${own ? ". This page uses this key." : ""}`,
        consequence: "The server rejects all further requests with this key. This cannot be undone; create a new key if needed.",
        verb: "Revoke",
      });
      if (!sure) return;
      await call("DELETE", `/v1/keys/${key.id}`);
      await renew();
    }, report, `Revoke the key ${key.name} ${key.id}`);
    const expires = key.expired ? ["expired ", when(key.expires_at)] : when(key.expires_at, "never");
    return row(own ? `${key.name} (this page)` : key.name, key.id, key.role, streams, when(key.created_at), expires, when(key.last_used_at, "never"), revoke);
  }

  at("new-key").addEventListener("submit", (event) => {
    event.preventDefault();
    report(async () => {
      const days = Number(at("key-expires").value);
      const streams = at("key-streams").value.split(/[\s,]+/).filter(Boolean);
      const made = await call("POST", "/v1/keys", {
        name: at("key-name").value,
        role: at("key-role").value,
        expires_at: days ? new Date(Date.now() + days * DAY_MS).toISOString() : null,
        streams: streams.length ? streams : null,
      });
      event.target.reset();
      await renew();
      await showKey(made);
    });
  });

  return renew;
}
