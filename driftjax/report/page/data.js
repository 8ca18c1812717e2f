"use strict";
// What Python embedded in the page, and elements whose text is never parsed as HTML.

const content = JSON.parse(document.getElementById("data").textContent);
const DEG = 180 / Math.PI;
const MISSING = 65535;

/** Return the numbers that `pack` of driftjax/report/html.py wrote; missing ones are NaN. */
function unpack({ low, step, b }) {
  const bytes = Uint8Array.from(atob(b), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float64Array.from({ length: bytes.length / 2 }, (_, k) => {
    const level = view.getUint16(2 * k, true);
    return level === MISSING ? NaN : low + step * level;
  });
}

function build(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children);
  return node;
}

/** Create an HTML element; children that are strings become text. */
function element(tag, attributes = {}, ...children) {
  return build(document.createElement(tag), attributes, children);
}

/** Create an SVG element. */
function svg(tag, attributes = {}, ...children) {
  return build(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

/** Return the last index at which `times`, which rise, are at most `t`; 0 before the first. */
function indexAt(times, t) {
  let low = 0;
  let high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** Return `values` at `t`, linear between `times`, constant beyond them. */
function valueAt(times, values, t) {
  const k = indexAt(times, t);
  if (k + 1 >= times.length || t <= times[k]) return values[k];
  const share = (t - times[k]) / (times[k + 1] - times[k]);
  return values[k] + share * (values[k + 1] - values[k]);
}

function format(value, digits = 2) {
  return Number.isFinite(value) ? value.toFixed(digits) : "\u2013";
}

/** Return a labelled choice; `options` are [value, words]. */
function choice(label, options, change) {
  const select = element("select", { "aria-label": label, onchange: () => change(select.value) });
  for (const [value, words] of options) select.append(element("option", { value }, words));
  return { node: element("label", {}, label, select), select };
}

/** Return a legend of [class, words, dashed?]. */
function legend(entries) {
  const swatch = (kind, dashed) => element("span", { class: `swatch ${kind}${dashed ? " dashed" : ""}` });
  return element("div", { class: "legend" },
    ...entries.map(([kind, words, dashed]) => element("span", {}, swatch(kind, dashed), words)));
}
