// Questions before something that cannot be undone, and a secret that is shown once.

const at = (id) => document.getElementById(id);

/**
 * Ask before something is deleted or ended. `what` names it with its number, `consequence` says what is lost, `verb` is the button's text.
 * Resolves to true only after that button was pressed; Escape and Cancel are no.
 */
export async function confirmed({ title, what, consequence, verb = "Delete" }) {
  const dialog = at("confirm");
  if (dialog.open) return false;
  at("confirm-title").textContent = title;
  at("confirm-what").textContent = what;
  at("confirm-consequence").textContent = consequence;
  at("confirm-yes").textContent = verb;
  dialog.returnValue = "";
  dialog.showModal();
  at("confirm-no").focus(); // Enter alone deletes nothing
  await new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
  return dialog.returnValue === "yes";
}

/** Show a new key until the dialog is closed; it is nowhere on the page afterwards. */
export async function showKey(made) {
  const dialog = at("made-key"), place = at("made-key-secret");
  at("made-key-name").textContent = `${made.name}, ${made.role}, ID ${made.id}`;
  at("made-key-copied").value = "";
  place.value = made.key;
  dialog.showModal();
  place.select();
  await new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
  place.value = "";
}

at("made-key-copy").addEventListener("click", async () => {
  at("made-key-secret").select();
  try {
    await navigator.clipboard.writeText(at("made-key-secret").value);
    at("made-key-copied").value = "copied";
  } catch { // without TLS a page has no clipboard
    at("made-key-copied").value = "selected: press Ctrl+C";
  }
});
