// Colour legend of a layer: a bar from low to high, with the limits of the image header.

const UNITS = { mm: "mm", relative: "× median depth, no scale known", confidence: "confidence" };

/** Draw the legend of an image header on a canvas, if there is one and it differs from the drawn one. */
export function drawLegend(canvas, legend) {
  const said = JSON.stringify(legend);
  if (!legend || canvas.dataset.said === said) return;
  canvas.dataset.said = said;
  const { width, height } = canvas;
  const pen = canvas.getContext("2d");
  const places = { left: 90, right: width - 250, bar: 14 };
  pen.clearRect(0, 0, width, height);
  const colours = pen.createLinearGradient(places.left, 0, places.right, 0);
  legend.stops.forEach((colour, index) => colours.addColorStop(index / (legend.stops.length - 1), colour));
  pen.fillStyle = colours;
  pen.fillRect(places.left, 4, places.right - places.left, places.bar);
  pen.fillStyle = "#f0f4f8";
  pen.font = "18px system-ui, sans-serif";
  pen.textAlign = "right";
  pen.fillText(number(legend.low), places.left - 8, 18);
  pen.textAlign = "left";
  pen.fillText(number(legend.high), places.right + 8, 18);
  pen.fillStyle = "#a9b4c0";
  pen.font = "16px system-ui, sans-serif";
  pen.fillText(UNITS[legend.unit] ?? legend.unit, places.left, 36);
  pen.fillStyle = legend.unobserved;
  pen.fillRect(places.right + 70, 4, 22, places.bar);
  pen.strokeStyle = "#963caa";
  pen.lineWidth = 2;
  pen.strokeRect(places.right + 70, 4, 22, places.bar);
  pen.fillStyle = "#a9b4c0";
  pen.fillText("never observed", places.right + 100, 18);
}

function number(value) {
  return Math.abs(value) >= 100 ? value.toFixed(0) : value.toPrecision(3);
}
