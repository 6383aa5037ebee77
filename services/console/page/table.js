// Rows of a table from data, without markup in strings: what a server says is text.

/** A row of cells; a cell is text, or elements. */
export function row(...cells) {
  const line = document.createElement("tr");
  for (const cell of cells) {
    const place = document.createElement("td");
    place.append(...(Array.isArray(cell) ? cell : [cell === null || cell === undefined ? "" : String(cell)]));
    line.append(place);
  }
  return line;
}

/** A button that does something async; it cannot be pressed again before that is over. */
export function button(text, act, report) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", async () => {
    made.disabled = true;
    await report(act);
    made.disabled = false;
  });
  return made;
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
