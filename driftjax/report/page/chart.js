// Charts in SVG that are drawn anew when their width changes, so that text keeps its size on a phone.

const MARGIN = { left: 52, right: 10, top: 20, bottom: 30 };

/** Return a node that calls `draw(svg, width)` whenever its width changes. */
function responsive(height, label, draw) {
  const picture = svg("svg", { role: "img", "aria-label": label, height });
  const node = element("div", { class: "chart" }, picture);
  let width = 0;
  const redraw = () => {
    width = Math.round(node.clientWidth);
    if (!width) return;
    picture.replaceChildren();
    picture.setAttribute("viewBox", `0 0 ${width} ${height}`);
    draw(picture, width);
  };
  new ResizeObserver(() => {
    if (Math.round(node.clientWidth) !== width) redraw();
  }).observe(node);
  return { node, picture, redraw };
}

/** Return about `count` round numbers from `low` to `high`. */
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
  return found;
}

/** Return 1, 2 and 5 of every decade from `low` to `high`. */
function logTicks(low, high) {
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1)
    for (const factor of [1, 2, 5]) found.push(factor * 10 ** power);
  return found.filter((value) => value >= low * 0.999 && value <= high * 1.001);
}

const short = (value) => String(Number(value.toPrecision(3)));

/** Return smallest and largest finite number of several arrays, some room beyond; `log` for positive ones only. */
function range(arrays, log = false) {
  let low = Infinity;
  let high = -Infinity;
  for (const values of arrays)
    for (const value of values)
      if (Number.isFinite(value) && (!log || value > 0)) {
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
  if (low > high) return log ? [0.1, 1] : [0, 1];
  if (log) return [low / 1.3, high * 1.3];
  const room = (high - low || Math.abs(high) || 1) * 0.06;
  return [low - room, high + room];
}

/** Return the map of numbers to pixels. */
function scale([low, high], from, to, log = false) {
  const f = log ? Math.log10 : (value) => value;
  return (value) => from + ((f(value) - f(low)) / (f(high) - f(low))) * (to - from);
}

/** Draw grid, ticks and labels; returns the scales. */
function axes(picture, width, height, { x, y, title, xLabel, log, xTicks }) {
  const right = width - MARGIN.right;
  const bottom = height - (xLabel ? MARGIN.bottom : 8);
  const sx = scale(x, MARGIN.left, right);
  const sy = scale(y, bottom, MARGIN.top, log);
  let marks = log ? logTicks(...y) : ticks(...y, (bottom - MARGIN.top) / 18);
  const decade = (value) => Math.abs(Math.log10(value) - Math.round(Math.log10(value))) < 1e-6;
  if (log && marks.length > 7) marks = marks.filter(decade);
  for (const value of marks) {
    picture.append(svg("line", { class: "grid", x1: MARGIN.left, x2: right, y1: sy(value), y2: sy(value) }));
    picture.append(svg("text", { class: "tick", x: MARGIN.left - 6, y: sy(value) + 4, "text-anchor": "end" }, short(value)));
  }
  if (xLabel) {
    for (const value of xTicks || ticks(...x, (right - MARGIN.left) / 70))
      picture.append(svg("text", { class: "tick", x: sx(value), y: bottom + 14, "text-anchor": "middle" }, short(value)));
    picture.append(svg("text", { class: "tick", x: right, y: height - 2, "text-anchor": "end" }, xLabel));
  }
  picture.append(svg("text", { x: 2, y: 12 }, title));
  return { sx, sy, bottom, right };
}

/** Return the path of a curve, broken where a number is missing or outside of `x`. */
function curvePath(xs, ys, sx, sy, [low, high] = [-Infinity, Infinity]) {
  let path = "";
  let pen = "M";
  for (let k = 0; k < xs.length; k += 1) {
    if (!Number.isFinite(ys[k]) || xs[k] < low || xs[k] > high) {
      pen = "M";
      continue;
    }
    path += `${pen}${sx(xs[k]).toFixed(1)} ${sy(ys[k]).toFixed(1)}`;
    pen = "L";
  }
  return path;
}

let numCharts = 0;

/**
 * Return a chart of curves { x, y, kind, style, words } with a cursor.
 * `options()` gives { series, x, y?, title, xLabel?, log? }; `scrub(x)` is called where the pointer is dragged.
 */
function lineChart(height, label, options, scrub) {
  let scales = null;
  let at = NaN;
  let line = null;
  const name = `clip-${(numCharts += 1)}`;
  const drawCursor = () => {
    if (!scales || !line) return;
    const inside = at >= scales.x[0] && at <= scales.x[1];
    line.setAttribute("visibility", inside ? "visible" : "hidden");
    if (inside) for (const end of ["x1", "x2"]) line.setAttribute(end, scales.sx(at));
  };
  const chart = responsive(height, label, (picture, width) => {
    const { series, title, xLabel, log, x, y } = options();
    const across = x || range(series.map((one) => one.x), false);
    const seen = (one) => Array.from(one.y).filter((_, k) => one.x[k] >= across[0] && one.x[k] <= across[1]);
    const drawn = axes(picture, width, height, { x: across, y: y || range(series.map(seen), log), title, xLabel, log });
    scales = { ...drawn, x: across };
    const [left, top] = [MARGIN.left, MARGIN.top];
    const frame = svg("rect", { x: left, y: top, width: drawn.right - left, height: drawn.bottom - top });
    const curves = svg("g", { "clip-path": `url(#${name})` });
    picture.append(svg("clipPath", { id: name }, frame), curves);
    for (const one of series) {
      const path = curvePath(one.x, one.y, drawn.sx, drawn.sy, across);
      curves.append(svg("path", { class: `line ${one.kind} ${one.style || ""}`, d: path }, svg("title", {}, one.words || "")));
    }
    line = svg("line", { class: "cursor", y1: MARGIN.top, y2: drawn.bottom });
    if (scrub) picture.append(line);
    drawCursor();
  });
  if (scrub) {
    const move = (event) => {
      if (!scales || !(event.buttons & 1)) return;
      const place = event.clientX - chart.picture.getBoundingClientRect().left;
      const share = (place - MARGIN.left) / (scales.right - MARGIN.left);
      scrub(scales.x[0] + Math.min(Math.max(share, 0), 1) * (scales.x[1] - scales.x[0]));
    };
    chart.picture.classList.add("scrub");
    chart.picture.addEventListener("pointerdown", (event) => {
      chart.picture.setPointerCapture(event.pointerId); // a drag goes on beyond the trace
      move(event);
    });
    chart.picture.addEventListener("pointermove", move);
  }
  const cursor = (value) => {
    at = value;
    drawCursor();
  };
  return { ...chart, cursor };
}
