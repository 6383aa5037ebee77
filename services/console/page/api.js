// Requests to the API with the key of this tab. A key that is refused asks for another one.

import { sha256 } from "./sha256.js";

const STORED = "intrasplat-key";
let key = sessionStorage.getItem(STORED) ?? "";
let askForKey = async () => { throw new Error("nobody asks for a key yet"); };
let asked = null;
let changed = () => {};

/** An answer that is no success, with what the server says about it. */
export class Problem extends Error {
  constructor(status, document) {
    super(document?.detail || document?.title || `the server answered ${status}`);
    this.status = status;
  }
}

/** `ask` is an async function that resolves to a key; it is called once for all requests that wait. `onChange` is called after there is a new key. */
export function setKeyDialog(ask, onChange) {
  askForKey = ask;
  changed = onChange;
}

/** Forget the key of this tab, and all that was shown with it. */
export function signOut() {
  sessionStorage.removeItem(STORED);
  location.reload();
}

/** The key of this tab from now on; kept until the tab is closed. */
export function useKey(given) {
  key = given.trim();
  sessionStorage.setItem(STORED, key);
}

async function newKey(reason) {
  asked ??= askForKey(reason).then(useKey).finally(() => { asked = null; changed(); }); // nothing waits for it: it may need another key
  await asked;
}

/** Call the API; returns the JSON of the answer, or null where it has none. Throws Problem, and TypeError without a connection. */
export async function call(method, path, body, headers = {}) {
  return documentOf(await ask(method, path, body, headers));
}

/** Fetch a file and let the browser save it under the name that the server gives it. Throws as `call`. */
export async function download(path) {
  const answer = await ask("GET", path);
  const name = /filename="([^"]+)"/.exec(answer.headers.get("content-disposition") ?? "")?.[1] ?? "export";
  const address = URL.createObjectURL(await answer.blob());
  Object.assign(document.createElement("a"), { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** Fetch a file; returns the answer. Throws as `call`. */
export async function fetched(path) {
  return ask("GET", path);
}

/** The address of a path with a ticket, for what cannot send a key. It is good once, and soon. */
export async function useTicket(path) {
  const { ticket } = await call("POST", "/v1/tickets", { path });
  return `${path}?ticket=${encodeURIComponent(ticket)}`;
}

async function documentOf(answer) {
  if (answer.status === 204) return null; // it has no body, whatever its type says
  return answer.headers.get("content-type")?.includes("json") ? answer.json() : null;
}

async function ask(method, path, body, headers = {}) {
  for (;;) {
    if (!key) await newKey("");
    const used = key;
    const answer = await fetch(path, {
      method,
      headers: { ...headers, Authorization: `Bearer ${used}`, ...(body === undefined ? {} : { "Content-Type": "application/json" }) },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
    if (answer.ok) return answer;
    const document = await documentOf(answer);
    if (answer.status !== 401) throw new Problem(answer.status, document);
    if (used === key) await newKey(document?.detail ?? "The key was refused.");
  }
}

/** Put a file, with its SHA-256 and a call of `progress(share)` now and then. Throws Problem. */
export async function upload(path, file, progress) {
  const digest = await sha256(file);
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch does not say how much was sent
    request.open("PUT", path);
    request.setRequestHeader("Authorization", `Bearer ${key}`);
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.setRequestHeader("Content-Digest", `sha-256=:${digest}:`);
    request.responseType = "json";
    request.upload.onprogress = (event) => { if (event.lengthComputable) progress(event.loaded / event.total); };
    request.onload = () => (request.status < 300 ? resolve(request.response) : reject(new Problem(request.status, request.response)));
    request.onerror = () => reject(new Error("the connection broke off while the file was sent; try again"));
    request.send(file);
  });
}
