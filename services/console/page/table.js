// Rows of a table from data, without markup in strings: what a server says is text.

/** A row of cells; a cell is text, or elements. */
export function row(...cells) {
  const line = document.createElement("tr");
  for (const cell of cells) {
    const place = document.createElement("td");
    const parts = Array.isArray(cell) ? cell : [cell];
    place.append(...parts.map((part) => (part instanceof Node ? part : String(part ?? ""))));
    line.append(place);
  }
  return line;
}

/** A button that does something async; it cannot be pressed again before that is over. `name` tells what it acts on to programs that read aloud. */
export function button(text, act, report, name = "") {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  if (name) made.setAttribute("aria-label", name);
  made.addEventListener("click", async () => {
    made.disabled = true;
    await report(act);
    made.disabled = false;
    const has = document.activeElement; // not this button, which was disabled: nothing, or what a closed dialog had
    if (!has || has === document.body || has.closest("dialog:not([open])")) sameButton(made)?.focus();
  });
  return made;
}

/** The button, or the one of its name in a table that was drawn anew. */
function sameButton(made) {
  const name = made.getAttribute("aria-label");
  return made.isConnected ? made : [...document.querySelectorAll("button[aria-label]")].find((each) => each.getAttribute("aria-label") === name);
}

/** Put rows in place of those of a table, unless somebody uses a button in it right now. */
export function replaceRows(body, rows) {
  if (body.contains(document.activeElement)) {
    const at = [...body.querySelectorAll("button")].indexOf(document.activeElement);
    body.replaceChildren(...rows);
    body.querySelectorAll("button")[at]?.focus();
    return;
  }
  body.replaceChildren(...rows);
}

/** A number of bytes for people. */
export function size(bytes) {
  const units = ["B", "KiB", "MiB", "GiB"];
  let unit = 0;
  while (bytes >= 1024 && unit < units.length - 1) { bytes /= 1024; unit += 1; }
  return `${bytes.toFixed(unit ? 1 : 0)} ${units[unit]}`;
}

/** The beginning of a SHA-256, and all of it when the pointer rests on it. */
export function digest(hex) {
  const place = document.createElement("code");
  place.textContent = hex.slice(0, 12);
  place.title = hex;
  return place;
}

/** Text that may have no spaces, such as an address: it is broken anywhere, and its column is not narrower than some words. */
export function long(text) {
  return Object.assign(document.createElement("span"), { className: "long", textContent: text });
}
