// API requests with this tab's key. If the server rejects the key, the user is asked for another one.

import { sha256 } from "./sha256.js";

const STORED = "intrasplat-key";
let key = sessionStorage.getItem(STORED) ?? "";
let askForKey = async () => { throw new Error("nobody asks for a key yet"); };
let asked = null;
let changed = () => {};

/** A response with an error status, with the problem document of the server. */
export class Problem extends Error {
  constructor(status, document) {
    super(document?.detail || document?.title || `the server answered ${status}`);
    this.status = status;
  }
}

/** Set `ask`, an async function that resolves to a key; pending requests share one call. `onChange` is called after a key change. */
export function setKeyDialog(ask, onChange) {
  askForKey = ask;
  changed = onChange;
}

/** Delete this tab's key, and reload to remove the displayed data. */
export function signOut() {
  sessionStorage.removeItem(STORED);
  location.reload();
}

/** Use a key for all further requests; it is stored until the tab is closed. */
export function useKey(given) {
  key = given.trim();
  sessionStorage.setItem(STORED, key);
}

async function newKey(reason) {
  asked ??= askForKey(reason).then(useKey).finally(() => { asked = null; changed(); }); // not awaited: its requests may ask for another key
  await asked;
}

/** Call the API and return the JSON body, or null without one. Throws Problem, or TypeError without a connection. */
export async function call(method, path, body, headers = {}) {
  return documentOf(await ask(method, path, body, headers));
}

/** Fetch a file and let the browser save it under the server's file name. Throws like `call`. */
export async function download(path) {
  const answer = await ask("GET", path);
  const name = /filename="([^"]+)"/.exec(answer.headers.get("content-disposition") ?? "")?.[1] ?? "export";
  const address = URL.createObjectURL(await answer.blob());
  Object.assign(document.createElement("a"), { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** Fetch a file and return the response. Throws like `call`. */
export async function fetched(path) {
  return ask("GET", path);
}

/** Send a request with a JSON body and return the response, whose body is a file. Throws like `call`. */
export async function posted(path, body) {
  return ask("POST", path, body);
}

/** Return the URL of a path with a ticket, for requests that cannot send a header. A ticket is short-lived and valid once. */
export async function useTicket(path) {
  const { ticket } = await call("POST", "/v1/tickets", { path });
  return `${path}?ticket=${encodeURIComponent(ticket)}`;
}

async function documentOf(answer) {
  if (answer.status === 204) return null; // no body, whatever the content type
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
    if (used === key) await newKey(document?.detail ?? "The server rejected the key.");
  }
}

/** Upload a file with its SHA-256; `progress(share)` is called during the upload. Throws Problem. */
export async function upload(path, file, progress) {
  const digest = await sha256(file);
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch does not report upload progress
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
