// Display of times in the browser's time zone, with UTC as tooltip.

const LOCAL = new Intl.DateTimeFormat(undefined, {
  year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit", timeZoneName: "short",
});

/** Return an element with a server time in the browser's time zone, `otherwise` for null, or an invalid time itself. */
export function when(iso, otherwise = "") {
  const time = new Date(iso ?? NaN);
  if (Number.isNaN(time.getTime())) return iso ?? otherwise;
  const place = document.createElement("time");
  place.dateTime = time.toISOString();
  place.title = `${time.toISOString().replace("T", " ").replace(/\.\d+Z$/, "")} UTC`;
  place.textContent = LOCAL.format(time);
  return place;
}

/** Format a duration: in ms below one second, otherwise in s; "" if it is not finite. */
export function age(ms) {
  if (!Number.isFinite(ms)) return "";
  return ms < 1000 ? `${Math.round(ms)} ms` : `${(ms / 1000).toFixed(1)} s`;
}
