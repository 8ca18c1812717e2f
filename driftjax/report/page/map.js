// The map: road, paths and cars on a canvas, in metres, y up.

/** Return the colour of a CSS custom property, which differs between light and dark. */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Return the transform from metres to pixels that fits `box` [[x0, x1], [y0, y1]] into the canvas. */
function fit(box, width, height) {
  const [[x0, x1], [y0, y1]] = box;
  const zoom = Math.min(width / (x1 - x0), height / (y1 - y0));
  const left = width / 2 - (zoom * (x0 + x1)) / 2;
  const top = height / 2 + (zoom * (y0 + y1)) / 2;
  return { zoom, x: (value) => left + zoom * value, y: (value) => top - zoom * value };
}

function trace(pen, view, xs, ys, from = 0, to = xs.length) {
  pen.beginPath();
  let down = false;
  for (let k = from; k < to; k += 1) {
    const drawn = Number.isFinite(xs[k]) && Number.isFinite(ys[k]);
    if (drawn) pen[down ? "lineTo" : "moveTo"](view.x(xs[k]), view.y(ys[k]));
    down = drawn;
  }
}

function drawRoad(pen, view, road) {
  const { left, right, path } = road;
  pen.fillStyle = colour("road");
  if (road.closed) {
    pen.beginPath();
    for (const side of [left, right]) {
      side.x.forEach((x, k) => pen[k ? "lineTo" : "moveTo"](view.x(x), view.y(side.y[k])));
      pen.closePath();
    }
    pen.fill("evenodd");
  } else {
    trace(pen, view, [...left.x, ...[...right.x].reverse()], [...left.y, ...[...right.y].reverse()]);
    pen.fill();
  }
  pen.strokeStyle = colour("soft");
  pen.lineWidth = 1;
  for (const side of [left, right]) {
    trace(pen, view, side.x, side.y);
    pen.stroke();
  }
  pen.setLineDash([6, 4]);
  trace(pen, view, path.x, path.y);
  pen.stroke();
  pen.setLineDash([]);
}

/** Draw a band along the path of `piece`, half as wide on each side as `width` [m] says. */
function drawBand(pen, view, piece, width) {
  const side = (sign) => [...piece.x].map((x, k) => {
    const course = piece.psi[k] + piece.beta[k];
    return [x - sign * width(k) * Math.sin(course), piece.y[k] + sign * width(k) * Math.cos(course)];
  });
  const ring = [...side(1), ...side(-1).reverse()].filter((point) => point.every(Number.isFinite));
  trace(pen, view, ring.map((point) => point[0]), ring.map((point) => point[1]));
  pen.fillStyle = colour("band");
  pen.globalAlpha = 0.35;
  pen.fill();
  pen.globalAlpha = 1;
}

/** Place points (u ahead, v left) of a car at its pose, in pixels. */
function placed(view, at, points) {
  const [c, s] = [Math.cos(at.psi), Math.sin(at.psi)];
  return points.map(([u, v]) => [view.x(at.x + c * u - s * v), view.y(at.y + s * u + c * v)]);
}

function polygon(pen, corners) {
  pen.beginPath();
  corners.forEach(([x, y], k) => pen[k ? "lineTo" : "moveTo"](x, y));
  pen.closePath();
}

/** Draw a car at scale: body, four wheels, the front ones steered, heading (dashed) and velocity (arrow). */
function drawCar(pen, view, car, at, kind, ghost) {
  polygon(pen, placed(view, at, car.body));
  pen.fillStyle = pen.strokeStyle = colour(kind);
  pen.globalAlpha = ghost ? 0.25 : 0.75;
  pen.fill();
  pen.globalAlpha = 1;
  pen.lineWidth = 1.5;
  pen.stroke();
  const delta = at.delta ?? 0;
  car.places.forEach(([u, v], k) => {
    const turn = k < 2 ? delta : 0;
    const [c, s] = [Math.cos(turn), Math.sin(turn)];
    const rim = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([i, j]) => [(i * car.length) / 2, (j * car.width) / 2]);
    polygon(pen, placed(view, at, rim.map(([i, j]) => [u + c * i - s * j, v + s * i + c * j])));
    pen.fillStyle = colour("tyre");
    pen.fill();
  });
  if (ghost) return;
  const reach = Math.max(...car.body.map(([u]) => u));
  const [ahead] = placed(view, at, [[1.8 * reach, 0]]);
  const [middle] = placed(view, at, [[0, 0]]);
  pen.setLineDash([3, 3]);
  line(pen, middle, ahead, colour("ink"), 1);
  pen.setLineDash([]);
  const long = (0.25 * at.V * reach) / 2.3; // a quarter of a second of travel, for a car of full size
  const course = { ...at, psi: at.psi + at.beta };
  const [tip] = placed(view, course, [[long, 0]]);
  line(pen, middle, tip, colour("ink"), 2.5);
  const head = Math.min(9, 0.4 * Math.hypot(tip[0] - middle[0], tip[1] - middle[1]));
  const angle = Math.atan2(tip[1] - middle[1], tip[0] - middle[0]);
  polygon(pen, [0, 2.6, -2.6].map((turn) => (turn ? [tip[0] + head * Math.cos(angle + turn), tip[1] + head * Math.sin(angle + turn)] : tip)));
  pen.fillStyle = colour("ink");
  pen.fill();
}

function line(pen, from, to, stroke, width) {
  pen.strokeStyle = stroke;
  pen.lineWidth = width;
  pen.beginPath();
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.stroke();
}

/** Draw a bar of a round number of metres. */
function drawScaleBar(pen, view, height) {
  const metres = logTicks(0.01, 110 / view.zoom).at(-1);
  const [x, y] = [14, height - 14];
  line(pen, [x, y], [x + metres * view.zoom, y], colour("ink"), 2);
  pen.fillStyle = colour("ink");
  pen.font = "12px system-ui, sans-serif";
  pen.fillText(`${short(metres)} m`, x, y - 6);
}

/** Draw a frame: { box, road, car, paths: [{ piece, from, to, kind, faint }], band, cars: [{ at, kind, ghost }] }. */
function drawMap(canvas, frame) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width || !height) return;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const view = fit(frame.box, width, height);
  if (frame.road) drawRoad(pen, view, frame.road);
  if (frame.band) drawBand(pen, view, frame.band.piece, frame.band.width);
  for (const { xs, ys, from, to, kind, faint, dashed } of frame.paths) {
    pen.strokeStyle = colour(kind);
    pen.globalAlpha = faint ? 0.45 : 1;
    pen.lineWidth = faint ? 1.2 : 2.2;
    pen.setLineDash(dashed ? [2, 3] : []);
    trace(pen, view, xs, ys, from, to);
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }
  for (const { at, kind, ghost } of frame.cars) drawCar(pen, view, frame.car, at, kind, ghost);
  drawScaleBar(pen, view, height);
}
