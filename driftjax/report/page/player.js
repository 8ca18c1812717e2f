// The player: two cars of a run, one of them as a ghost, on the map and over time.

const TRACES = [
  { key: "V", words: "speed V [m/s]", factor: 1, reference: "V_ref", digits: 1 },
  { key: "beta", words: "sideslip beta [deg]", factor: DEG, reference: "beta_ref", digits: 1 },
  { key: "r", words: "yaw rate r [deg/s]", factor: DEG, reference: "r_ref", digits: 1 },
  { key: "delta", words: "steering delta [deg]", factor: DEG, reference: "delta_command", digits: 1 },
  { key: "Fxr", words: "drive force Fxr [N]", factor: 1, reference: "Fxr_command", digits: 0 },
  { key: "e", words: "lateral error e [m]", factor: 1, digits: 2 },
];
const RATES = { dV: ["speed", 1, "m/s²"], dbeta: ["sideslip", DEG, "deg/s"], dr: ["yaw rate", DEG, "deg/s²"] };
const SPEEDS = [["0.25", "¼ ×"], ["0.5", "½ ×"], ["1", "real time"], ["2", "2 ×"]];

/** Return a drive with its numbers unpacked, once. */
function unpacked(drive) {
  drive.arrays ??= drive.pieces.map((piece) =>
    Object.fromEntries(Object.entries(piece).map(([name, packed]) => [name, unpack(packed)])));
  return drive.arrays;
}

/** Return piece and values of a drive at time `t`: a single piece stands still at its end, predictions vanish there. */
function stateAt(drive, t) {
  const pieces = unpacked(drive);
  const begun = pieces.filter((piece) => piece.t[0] <= t + 1e-9);
  const piece = begun.at(-1) || (pieces.length === 1 ? pieces[0] : null);
  if (!piece || (pieces.length > 1 && t > piece.t.at(-1) + 1e-9)) return null;
  const at = Object.fromEntries(Object.entries(piece).map(([name, values]) => [name, valueAt(piece.t, values, t)]));
  return { piece, at, index: indexAt(piece.t, t) };
}

class Player {
  constructor(root, { car, drives, road, left_out: leftOut }) {
    Object.assign(this, { root, car, drives, t: 0, playing: false, speed: 1, rate: "" });
    this.road = road && { ...road };
    for (const name of ["left", "right", "path"])
      if (road) this.road[name] = { x: unpack(road[name].x), y: unpack(road[name].y) };
    this.view = road ? "corner" : "car";
    this.build(leftOut);
    this.chooseGroup(drives[0].group);
    document.addEventListener("keydown", (event) => this.key(event));
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  build(leftOut) {
    const groups = [...new Set(this.drives.map((drive) => drive.group))];
    const list = (words) => words.map((word) => [word, word]);
    this.groupChoice = choice("Plant or run", list(groups), (value) => this.chooseGroup(value));
    this.mainChoice = choice("Car", [], (value) => this.choose(Number(value), this.ghostIndex));
    this.ghostChoice = choice("Ghost", [], (value) => this.choose(this.mainIndex, Number(value)));
    const views = [["car", "follow the car"], ["all", "everything"]];
    this.viewChoice = choice("View", this.road ? [["corner", "the corner"], ...views] : views, (value) => {
      this.view = value;
      this.setWindow();
    });
    this.speedChoice = choice("Playback", SPEEDS, (value) => { this.speed = Number(value); });
    this.speedChoice.select.value = "1";
    this.rateChoice = choice("GP uncertainty along the path", [], (value) => { this.rate = value; this.draw(); });
    this.button = element("button", { type: "button", "aria-keyshortcuts": "Space", onclick: () => this.toggle() }, "Play");
    this.slider = element("input", { type: "range", "aria-label": "time", oninput: () => this.seek(Number(this.slider.value)) });
    this.canvas = element("canvas", { role: "img", "aria-label": "map with the cars" });
    this.table = element("table", { class: "readout" });
    this.key_ = element("div");
    this.note = element("p", { class: "source" });
    this.charts = element("div");
    const choices = [this.groupChoice, this.mainChoice, this.ghostChoice, this.viewChoice, this.speedChoice, this.rateChoice];
    const help = "Space plays and stops, arrow keys step (with Shift ten steps), Home and End jump; drag on a trace to scrub.";
    this.root.append(
      element("div", { class: "controls" }, this.button, ...choices.map((one) => one.node)), this.slider,
      element("div", { class: "stagegrid" }, element("div", {}, this.canvas, this.key_, this.table, this.note), this.charts),
      element("p", { class: "source" }, help + (leftOut ? ` ${leftOut} further laps are left out to keep this page small; they are in the run folder.` : "")));
  }

  chooseGroup(group) {
    const mine = this.drives.map((drive, k) => [k, drive]).filter(([, drive]) => drive.group === group);
    const fill = ({ select }, extra) => select.replaceChildren(
      ...[...extra, ...mine.map(([k, drive]) => [k, drive.name])].map(([value, words]) => element("option", { value }, words)));
    fill(this.mainChoice, []);
    fill(this.ghostChoice, [[-1, "none"]]);
    const last = (kind) => mine.filter(([, drive]) => drive.kind === kind).map(([k]) => k);
    const pick = (wanted, fallback) => {
      const same = mine.find(([, drive]) => wanted && drive.name === wanted);
      return same ? same[0] : fallback;
    };
    const main = [...last("measured"), ...last("explored"), ...last("gpr"), mine.at(-1)[0]][0];
    const ghost = last("nominal")[0] ?? -1;
    const before = [this.drives[this.mainIndex]?.name, this.drives[this.ghostIndex]?.name];
    this.choose(pick(before[0], main), pick(before[1], ghost === main ? -1 : ghost));
  }

  choose(main, ghost) {
    Object.assign(this, { mainIndex: main, ghostIndex: ghost });
    this.mainChoice.select.value = main;
    this.ghostChoice.select.value = ghost;
    this.groupChoice.select.value = this.drives[main].group;
    this.main = this.drives[main];
    this.ghost = ghost < 0 ? null : this.drives[ghost];
    this.step = unpacked(this.main)[0].t[1] - unpacked(this.main)[0].t[0];
    const rates = Object.keys(RATES).filter((rate) => `gp_std_${rate}` in unpacked(this.main)[0]);
    this.rateChoice.node.hidden = !rates.length;
    const options = [["", "none"], ...rates.map((rate) => [rate, `of the ${RATES[rate][0]}`])];
    this.rateChoice.select.replaceChildren(...options.map(([value, words]) => element("option", { value }, words)));
    this.rate = rates.includes(this.rate) ? this.rate : rates.at(-1) || "";
    this.rateChoice.select.value = this.rate;
    Object.assign(this.root.dataset, { car: this.main.name, ghost: this.ghost ? this.ghost.name : "", group: this.main.group });
    this.buildCharts();
    this.setWindow();
  }

  /** Set the span of time shown: the corner, or everything. */
  setWindow() {
    const [lap] = unpacked(this.main);
    const ends = [this.main, this.ghost].filter(Boolean).map((drive) => unpacked(drive).at(-1).t.at(-1));
    this.window = [lap.t[0], Math.max(...ends)];
    if (this.view === "corner" && lap.s) {
      const within = [...lap.t].filter((_, k) => lap.s[k] >= this.road.s[0] && lap.s[k] <= this.road.s[1]);
      if (within.length > 1) this.window = [within[0], within.at(-1)];
    }
    Object.assign(this.slider, { min: this.window[0], max: this.window[1], step: this.step });
    this.redrawCharts();
    this.seek(this.t > this.window[0] && this.t < this.window[1] ? this.t : this.startTime());
  }

  /** Return the time at which the picture tells most: two fifths into the drift, or late in the first prediction. */
  startTime() {
    const [lap] = unpacked(this.main);
    const predicted = this.ghost && unpacked(this.ghost).length > 1 && unpacked(this.ghost)[0].t;
    if (predicted) return 0.4 * predicted[0] + 0.6 * predicted.at(-1);
    if (!this.road || !lap.s) return this.window[0];
    const wanted = 0.6 * this.road.drift[0] + 0.4 * this.road.drift[1];
    const k = lap.s.findIndex((s) => s >= wanted);
    return k < 0 ? this.window[0] : lap.t[k];
  }

  buildCharts() {
    const [lap] = unpacked(this.main);
    this.shown = TRACES.filter(({ key }) => key in lap);
    const drives = [["", this.main], ["thin", this.ghost]].filter(([, drive]) => drive);
    this.lines = this.shown.map(({ key, words, factor, reference }) => {
      const times = (values) => values.map((value) => factor * value);
      const series = [];
      for (const [style, drive] of [...drives].reverse())
        for (const piece of unpacked(drive))
          if (key in piece) series.push({ x: piece.t, y: times(piece[key]), kind: drive.kind, style, words: `${drive.name}\n${drive.source}: ${key}` });
      if (reference && reference in lap) series.push({ x: lap.t, y: times(lap[reference]), kind: "reference", style: "dashed", words: `${reference}\n${this.main.source}: ${reference}` });
      const focus = drives[0][1] === this.main && this.main.kind === "measured" ? range([times(lap[key])]) : undefined;
      const y = focus && [focus[0] - 0.3 * (focus[1] - focus[0]), focus[1] + 0.3 * (focus[1] - focus[0])];
      return { key, series, y, words };
    });
    const last = this.lines.length - 1;
    this.chartList = this.lines.map(({ key, series, y, words }, k) => {
      const shown = () => ({ series, x: this.window, y, title: words, xLabel: k === last ? "time t [s]" : "" });
      const chart = lineChart(k === last ? 128 : 106, words, shown, (t) => this.seek(t));
      chart.node.dataset.trace = key;
      return chart;
    });
    const reference = this.lines.some(({ series }) => series.some((one) => one.kind === "reference"));
    const entries = drives.map(([, drive]) => [drive.kind, drive.name]);
    if (reference) entries.push(["reference", "reference or command", true]);
    this.charts.replaceChildren(legend(entries), ...this.chartList.map((chart) => chart.node));
    this.note.textContent = drives.map(([, drive]) => `${drive.name}: ${[drive.note, `source ${drive.source}`].filter(Boolean).join("; ")}.`).join(" ");
  }

  redrawCharts() {
    for (const chart of this.chartList) chart.redraw();
  }

  toggle() {
    this.playing = !this.playing;
    this.button.textContent = this.playing ? "Stop" : "Play";
    if (!this.playing) return;
    if (this.t >= this.window[1] - 1e-9) this.seek(this.window[0]);
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      this.seek(this.t + (this.speed * (now - before)) / 1000);
      before = now;
      if (this.t >= this.window[1]) this.toggle();
      else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  key(event) {
    const inside = event.target === document.body || this.root.contains(event.target);
    if (!inside || event.target.matches("select, summary, a") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " " && event.target !== this.button) this.toggle();
    else {
      const many = event.shiftKey ? 10 : 1;
      const places = { ArrowRight: this.t + many * this.step, ArrowLeft: this.t - many * this.step, Home: this.window[0], End: this.window[1] };
      if (!(event.key in places)) return;
      this.seek(places[event.key]);
    }
    event.preventDefault();
  }

  seek(t) {
    this.t = Math.min(Math.max(t, this.window[0]), this.window[1]);
    this.slider.value = this.t;
    for (const chart of this.chartList) chart.cursor(this.t);
    this.draw();
  }

  /** Return the box of the map [m]. */
  box(at) {
    const size = 3 * Math.max(...this.car.body.map(([u]) => u)) * 2;
    if (this.view === "car") return [[at.x - size, at.x + size], [at.y - size, at.y + size]];
    if (this.view === "corner") {
      const pad = size / 5;
      return this.road.corner.map(([low, high]) => [low - pad, high + pad]);
    }
    const lines = this.road ? [this.road.left, this.road.right] : unpacked(this.main);
    return [range(lines.map((one) => one.x)), range(lines.map((one) => one.y))];
  }

  draw() {
    if (!this.main) return;
    const main = stateAt(this.main, this.t);
    const ghost = this.ghost && stateAt(this.ghost, this.t);
    if (!main) return;
    const paths = [];
    const cars = [];
    const { x_ref: xRef, y_ref: yRef } = main.piece;
    if (xRef) paths.push({ xs: xRef, ys: yRef, kind: "gp", faint: true, dashed: true });
    for (const [state, drive, shadow] of [[ghost, this.ghost, true], [main, this.main, false]]) {
      if (!state) continue;
      const { x, y } = state.piece;
      paths.push({ xs: x, ys: y, kind: drive.kind, faint: true });
      paths.push({ xs: x, ys: y, to: state.index + 1, kind: drive.kind, faint: shadow });
      cars.push({ at: state.at, kind: drive.kind, ghost: shadow });
    }
    const frame = { box: this.box(main.at), road: this.road, car: this.car, paths, cars, band: this.band(main.piece) };
    drawMap(this.canvas, frame);
    this.tell(main.at, ghost && ghost.at);
    this.explain(Boolean(xRef));
  }

  /** Return the band of the GP's standard deviation, at its widest as wide as the car on each side. */
  band(piece) {
    const spread = this.rate && piece[`gp_std_${this.rate}`];
    if (!spread) return null;
    const wide = 2 * Math.max(...this.car.body.map(([, v]) => v));
    this.widest = spread.reduce((most, value) => (value > most ? value : most), 0) || 1;
    return { piece, width: (k) => (spread[k] / this.widest) * wide };
  }

  explain(reference) {
    const entries = [];
    if (this.road) entries.push(["reference", "planned path and borders", true]);
    if (reference) entries.push(["gp", "path that the reference asks for", true]);
    if (this.rate && this.widest) {
      const [words, factor, unit] = RATES[this.rate];
      entries.push(["band", `GP's standard deviation of the ${words}'s rate, one car's width on each side is ${format(factor * this.widest, 2)} ${unit} (gp_std)`]);
    }
    entries.push(["floor", "arrow: velocity; dashed: heading"]);
    const words = JSON.stringify(entries);
    if (words !== this.explained) this.key_.replaceChildren(legend(entries));
    this.explained = words;
  }

  /** Write the numbers at this time, beside their source, and for screen readers on slider and map. */
  tell(main, ghost) {
    const rows = this.shown.map(({ key, words, factor, digits }) => {
      const cell = (at, drive) => element("td", { title: drive ? `${drive.source}: ${key}` : "" }, at && key in at ? format(factor * at[key], digits) : "\u2013");
      return element("tr", {}, element("th", { scope: "row" }, words), cell(main, this.main), cell(ghost, this.ghost));
    });
    const head = element("tr", {}, element("th", { scope: "col" }, `t = ${format(this.t)} s`), ...[[this.main, ""], [this.ghost, " (ghost)"]].map(([drive, extra]) =>
      element("th", { scope: "col", class: drive ? drive.kind : "" }, drive ? drive.name + extra : "no ghost")));
    this.table.replaceChildren(element("thead", {}, head), element("tbody", {}, ...rows));
    const words = `${format(this.t)} s: speed ${format(main.V, 1)} m/s, sideslip ${format(DEG * main.beta, 0)} degrees`;
    this.slider.setAttribute("aria-valuetext", words);
    this.canvas.setAttribute("aria-label", `Map, ${this.main.group}, ${this.main.name}, ${words}`);
    Object.assign(this.root.dataset, { time: this.t.toFixed(3), x: main.x.toFixed(3), y: main.y.toFixed(3) });
    Object.assign(this.root.dataset, { ghostX: ghost ? ghost.x.toFixed(3) : "", ghostY: ghost ? ghost.y.toFixed(3) : "" });
  }
}
