// Table rows from data. Server data is inserted as text only, never as markup.

/** Create a row; each cell is text or elements. */
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

/** Create a button with an async action; it is disabled until the action ends. `name` is its label for screen readers. */
export function button(text, act, report, name = "") {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  if (name) made.setAttribute("aria-label", name);
  made.addEventListener("click", async () => {
    made.disabled = true;
    await report(act);
    made.disabled = false;
    const has = document.activeElement; // the disabled button lost the focus to the body or to a closed dialog
    if (!has || has === document.body || has.closest("dialog:not([open])")) sameButton(made)?.focus();
  });
  return made;
}

/** Return the button or, if it was removed by redrawing the table, the first button with the same name, if any. */
function sameButton(made) {
  const name = made.getAttribute("aria-label");
  return made.isConnected ? made : [...document.querySelectorAll("button[aria-label]")].find((each) => each.getAttribute("aria-label") === name);
}

/** Replace the rows of a table. If one of its buttons has the focus, the new button at its position gets it. */
export function replaceRows(body, rows) {
  if (body.contains(document.activeElement)) {
    const at = [...body.querySelectorAll("button")].indexOf(document.activeElement);
    body.replaceChildren(...rows);
    body.querySelectorAll("button")[at]?.focus();
    return;
  }
  body.replaceChildren(...rows);
}

/** Format a number of bytes. */
export function size(bytes) {
  const units = ["B", "KiB", "MiB", "GiB"];
  let unit = 0;
  while (bytes >= 1024 && unit < units.length - 1) { bytes /= 1024; unit += 1; }
  return `${bytes.toFixed(unit ? 1 : 0)} ${units[unit]}`;
}

/** Show the beginning of a SHA-256, with the complete value as tooltip. */
export function digest(hex) {
  const place = document.createElement("code");
  place.textContent = hex.slice(0, 12);
  place.title = hex;
  return place;
}

/** Text that may lack spaces, such as a URL. It may wrap anywhere, and its column keeps a minimum width. */
export function long(text) {
  return Object.assign(document.createElement("span"), { className: "long", textContent: text });
}
