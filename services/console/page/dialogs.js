// Confirmation of irreversible actions, and the display of a new key.

const at = (id) => document.getElementById(id);

/**
 * Ask for confirmation. `what` identifies the object, `consequence` describes the data loss, `verb` is the label of the button.
 * Resolves to true if that button was pressed, and to false after Escape or Cancel.
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
  at("confirm-no").focus(); // so that Enter does not confirm
  await new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
  return dialog.returnValue === "yes";
}

/** Show a new key until the dialog is closed, then remove it from the page. */
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
  } catch { // the clipboard API requires a secure context
    at("made-key-copied").value = "selected: press Ctrl+C";
  }
});
