// Charts that do not move: learning curve, waterfall, errors over the noise floor, residual forces.

const hint = (words) => svg("title", {}, words);

/** Draw a value with its interval, along y if `upright`. */
function whisker(picture, kind, place, value, low, high, map, upright, words) {
  if (Number.isFinite(low) && Number.isFinite(high)) {
    const ends = upright ? { x1: place, x2: place, y1: map(low), y2: map(high) } : { y1: place, y2: place, x1: map(low), x2: map(high) };
    picture.append(svg("line", { class: `line ${kind}`, ...ends }, hint(words)));
  }
  const centre = upright ? { cx: place, cy: map(value) } : { cx: map(value), cy: place };
  picture.append(svg("circle", { class: `fill ${kind}`, r: 4.5, ...centre }, hint(words)));
}

/** Return the learning curve: mean lateral error per stage, 95 % interval, a small ring per plant; logarithmic. */
function learningCurve(results, labels, kinds, controllers) {
  const stages = results.stages;
  const used = Object.keys(results.summary || {});
  const cells = [];
  stages.forEach((stage, k) => {
    for (const [controller, cell] of Object.entries(stage.controllers)) {
      const error = cell.lateral_error;
      if (error && error.mean !== null) cells.push({ k, stage: stage.name, controller, error, cell });
    }
  });
  const values = (one) => [one.error.mean, ...(one.error.ci95 || []), ...Object.values(one.error.per_plant || {})];
  const numbers = cells.flatMap(values).filter((value) => value > 0.002);
  const height = 330;
  const foot = 96;
  return responsive(height, "Mean lateral error of every stage, logarithmic", (picture, width) => {
    const y = range([numbers], true);
    const { sy } = axes(picture, width, height - foot, { x: [0, 1], y, log: true, title: "mean lateral error in the drift [m]" });
    const place = scale([-0.5, stages.length - 0.5], MARGIN.left, width - MARGIN.right);
    const apart = Math.min((place(1) - place(0)) * 0.3, 14);
    stages.forEach((stage, k) => {
      const text = svg("text", { class: "tick", "text-anchor": "end", transform: `translate(${place(k) + 4} ${height - foot + 8}) rotate(-52)` }, labels[stage.name]);
      picture.append(text);
    });
    for (const { k, stage, controller, error, cell } of cells) {
      const shift = used.length > 1 && used.includes(controller) ? (used.indexOf(controller) - (used.length - 1) / 2) * apart : 0;
      const at = place(k) + shift;
      const key = `results.json: stages[${k}].controllers.${controller}.lateral_error`;
      const kind = kinds[stage];
      for (const [plant, value] of Object.entries(error.per_plant || {}))
        if (value > 0) picture.append(svg("circle", { class: `hollow ${kind}`, r: 2.5, cx: at + 5, cy: sy(Math.max(value, y[0])) }, hint(`${plant}: ${format(value, 3)} m\n${key}.per_plant`)));
      const [low, high] = error.ci95 || [];
      const spread = Number.isFinite(low) ? `95 % [${format(low, 3)}, ${format(high, 3)}]` : "no interval of so few plants";
      const words = `${labels[stage]}, ${controllers[controller] || controller}: ${format(error.mean, 3)} m, ${spread}, completed ${(cell.completed || []).join("/")}\n${key}`;
      whisker(picture, kind, at, error.mean, low === null ? NaN : Math.max(low, y[0]), high === null ? NaN : high, sy, true, words);
    }
  });
}

/** Return the waterfall of shares [%]: [name, before, after]. */
function waterfallChart(steps, explained) {
  const height = 300;
  const foot = 84;
  const label = steps.map(([name, before, after]) => `${name} ${format(Math.abs(after - before), 0)} %`).join(", ");
  return responsive(height, label, (picture, width) => {
    const low = Math.min(0, ...steps.map((step) => step[2]));
    const title = `excess squared error ${format(explained.horizon)} s ahead [%]; 0 is the noise floor`;
    const { sy } = axes(picture, width, height - foot, { x: [0, 1], y: [low, 112], title });
    const place = scale([-0.5, steps.length - 0.5], MARGIN.left, Math.min(width - MARGIN.right, MARGIN.left + 130 * steps.length));
    const wide = (place(1) - place(0)) * 0.7;
    steps.forEach(([name, before, after], k) => {
      const kind = k === 0 ? "nominal" : k === steps.length - 1 ? "other" : "extended";
      const top = Math.max(before, after);
      const key = k === 0 || k === steps.length - 1 ? "diagnosis.json: explained.share" : `diagnosis.json: causes, ${name}: share x explained.share`;
      const box = { x: place(k) - wide / 2, width: wide, y: sy(top), height: Math.max(sy(Math.min(before, after)) - sy(top), 1) };
      picture.append(svg("rect", { class: `fill ${kind}`, ...box }, hint(`${name}: ${format(Math.abs(after - before), 1)} %\n${key}`)));
      picture.append(svg("text", { x: place(k), y: sy(top) - 4, "text-anchor": "middle" }, `${format(Math.abs(after - before), 0)} %`));
      picture.append(svg("text", { class: "tick", "text-anchor": "end", transform: `translate(${place(k) + 6} ${height - foot + 10}) rotate(-35)` }, name));
    });
    picture.append(svg("line", { class: "axis", x1: MARGIN.left, x2: width - MARGIN.right, y1: sy(0), y2: sy(0) }));
  });
}

/** Return the held-out errors of one cause over the noise floor, a row per channel. */
function floorChart({ effect, channels, horizon }) {
  const names = Object.keys(channels);
  const rows = Object.values(channels);
  const height = 40 + 34 * names.length + 24;
  return responsive(height, `Errors over the noise floor, with and without ${effect}`, (picture, width) => {
    const numbers = [0.9, ...rows.flatMap((row) => [row.nominal, row.extended, ...row.without])].map((v) => (v === null ? NaN : v));
    const x = range([numbers], true);
    const sx = scale(x, 60, width - 16, true);
    picture.append(svg("text", { x: 2, y: 12 }, `error ${format(horizon)} s ahead over that of a right model`));
    const bottom = height - 24;
    for (const value of logTicks(...x)) {
      picture.append(svg("line", { class: value === 1 ? "axis" : "grid", x1: sx(value), x2: sx(value), y1: 24, y2: bottom }));
      picture.append(svg("text", { class: "tick", x: sx(value), y: bottom + 16, "text-anchor": "middle" }, short(value)));
    }
    names.forEach((name, k) => {
      const { nominal, extended, without } = channels[name];
      const y = 44 + 34 * k;
      const [value, low, high] = without.map((v) => (v === null ? NaN : v));
      picture.append(svg("text", { x: 8, y: y + 4 }, name));
      const say = (words, number) => `${name}, ${words}: ${format(number)} times the floor`;
      whisker(picture, "nominal", y - 7, nominal, NaN, NaN, sx, false, `${say("nominal car", nominal)}\ndiagnosis.json: gain.rmse.nominal`);
      if (Number.isFinite(value)) whisker(picture, "other", y, value, low, high, sx, false, `${say(`all causes but ${effect}`, value)}\ndiagnosis.json: gain.without.${effect}.${name}`);
      whisker(picture, "extended", y + 7, extended, NaN, NaN, sx, false, `${say("all causes", extended)}\ndiagnosis.json: gain.rmse.extended`);
    });
  });
}

/** Return residual forces [N] in bins with 95 % intervals, of each model, for a choice of `pick()`. */
function forceChart(forces, pick) {
  return responsive(260, "Mean residual force over its driver, 95 % intervals", (picture, width) => {
    const { driver, force, words, factor } = pick();
    const models = Object.entries(forces[driver]);
    const each = models.map(([model, one]) => {
      const clean = (row) => row.map((value) => (value === null ? NaN : value));
      return { model, x: clean(one.value).map((v) => v * factor), mean: clean(one.mean[force]), error: clean(one.error[force]), share: one.explained[force] };
    });
    const y = range([[0], ...each.flatMap((one) => [one.mean.map((v, k) => v + 1.96 * one.error[k]), one.mean.map((v, k) => v - 1.96 * one.error[k])])]);
    const { sx, sy, right } = axes(picture, width, 260, { x: range(each.map((one) => one.x)), y, title: "mean residual force [N]", xLabel: words });
    picture.append(svg("line", { class: "axis", x1: MARGIN.left, x2: right, y1: sy(0), y2: sy(0) }));
    for (const one of each) {
      picture.append(svg("path", { class: `line thin ${one.model}`, d: curvePath(one.x, one.mean, sx, sy) }));
      one.mean.forEach((value, k) => {
        if (!Number.isFinite(value)) return;
        const tell = `${one.model}: ${format(value, 1)} N, standard error ${format(one.error[k], 1)} N\ndiagnosis.nc: bin_mean, bin_error`;
        whisker(picture, one.model, sx(one.x[k]), value, value - 1.96 * one.error[k], value + 1.96 * one.error[k], sy, true, tell);
      });
    }
  });
}
