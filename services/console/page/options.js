// Form fields for engine options, generated from the server's OpenAPI document.

import { call } from "./api.js";

let described = null;

/** Add a field to `place` for each option of the request `schema`, such as "ReplayRequest". Does nothing if `place` has fields. */
export async function offerOptions(place, schema) {
  if (place.childElementCount) return;
  described ??= call("GET", "/openapi.json").catch((error) => { described = null; throw error; });
  const { schemas } = (await described).components;
  const wanted = schemas[schema].properties.options;
  const { properties } = wanted.$ref ? schemas[wanted.$ref.split("/").pop()] : wanted;
  if (!place.childElementCount) place.replaceChildren(...Object.entries(properties).map(labelled));
}

/** Return the options in `place` that differ from their defaults, by name. */
export function chosenOptions(place) {
  const options = {};
  for (const field of place.querySelectorAll("[data-option]")) {
    if (field.type === "checkbox") { if (field.checked !== field.defaultChecked) options[field.dataset.option] = field.checked; }
    else if ("list" in field.dataset) { if (field.value !== "") options[field.dataset.option] = field.value.split(",").map((word) => word.trim()); }
    else if (field.value !== "") options[field.dataset.option] = field.type === "number" ? Number(field.value) : field.value;
  }
  return options;
}

function labelled([name, schema]) {
  const label = document.createElement("label"), field = fieldOf(schema);
  const unit = schema["x-unit"] ? `, ${schema["x-unit"]}` : "";
  const text = `${name[0].toUpperCase()}${name.slice(1).replaceAll("_", " ")}${unit}`;
  field.dataset.option = name;
  label.title = schema.description ?? "";
  if (field.type === "checkbox") { label.className = "choice"; label.append(field, ` ${text}`); }
  else label.append(`${text} `, field);
  return label;
}

/** Create the field of an option. An empty field means the default, which is its placeholder. */
function fieldOf(schema) {
  const kinds = schema.anyOf ?? [schema], usual = schema.default ?? /; null: (.*)\.$/.exec(schema.description ?? "")?.[1] ?? "";
  const words = kinds.flatMap((kind) => kind.enum ?? []);
  const number = kinds.find((kind) => ["integer", "number"].includes(kind.type));
  if (words.length && !kinds.some((kind) => kind.pattern)) {
    const field = document.createElement("select");
    field.append(new Option(usual, ""), ...words.filter((word) => word !== usual).map((word) => new Option(word)));
    return field;
  }
  const field = document.createElement("input");
  if (kinds.some((kind) => kind.type === "boolean")) {
    field.type = "checkbox";
    field.defaultChecked = schema.default === true;
    return field;
  }
  field.placeholder = usual;
  const list = kinds.find((kind) => kind.type === "array");
  if (list) field.dataset.list = "";
  if (number) {
    field.type = "number";
    field.step = number.type === "integer" ? 1 : "any";
    field.min = number.minimum ?? number.exclusiveMinimum ?? "";
    field.max = number.maximum ?? number.exclusiveMaximum ?? "";
  } else {
    field.title = [...words, ...(list?.items.enum ?? list?.items.anyOf?.[0].enum ?? [])].join(", ");
    field.autocomplete = "off";
  }
  return field;
}
