// The page of `driftjax diagnose`.

const CHANNELS = [["V", "speed V [m/s]", 1], ["beta", "sideslip beta [deg]", DEG], ["r", "yaw rate r [deg/s]", DEG]];
const DRIVERS = {
  slip_front: ["front slip [deg]", DEG], slip_rear: ["rear slip [deg]", DEG], drive: ["drive force [N]", 1],
  speed: ["speed [m/s]", 1], time: ["time [s]", 1], heading: ["heading [deg]", DEG], position: ["position [m]", 1],
};
const FORCES = ["drive force", "front lateral force", "rear lateral force"];
const MODELS = { nominal: "nominal car", extended: "extended car", retuned: "re-tuned tyres", gp: "Gaussian process", extended_gp: "extended car with a Gaussian process" };

function showCauses(causes) {
  causes.forEach((cause, k) => {
    const root = document.getElementById(`cause-${k}`);
    if (!root) return;
    root.append(
      legend([["nominal", "nominal car"], ["other", `all causes but ${cause.effect}, the others refitted`], ["extended", "all causes"]]),
      floorChart(cause).node,
      element("p", { class: "source" }, "1 is the noise floor: what a right model would be off by. Held-out runs; source: diagnosis.json, gain.rmse and gain.without."));
  });
}

function showForces(root, forces) {
  const worst = Object.entries(forces).flatMap(([driver, { nominal }]) => nominal.explained.map((share, force) => ({ driver, force, share: share ?? 0 })));
  const now = worst.reduce((best, one) => (one.share > best.share ? one : best));
  const words = element("p", { class: "note" });
  const chart = forceChart(forces, () => {
    const [label, factor] = DRIVERS[now.driver] || [now.driver, 1];
    return { driver: now.driver, force: now.force, words: label, factor };
  });
  const update = (key, value) => {
    if (key) now[key] = value;
    const shares = Object.entries(forces[now.driver]).map(([model, one]) => `${format(100 * one.explained[now.force], 0)} % with the ${MODELS[model]}`);
    const driver = (DRIVERS[now.driver] || [now.driver])[0].replace(/ \[.*/, "");
    words.textContent = `Share of the variance of this residual force that goes with the ${driver}: ${shares.join(", ")}. Source: diagnosis.nc, bin_value, bin_mean, bin_error, explained.`;
    chart.redraw();
  };
  const force = choice("Residual", FORCES.map((name, k) => [k, name]), (value) => update("force", Number(value)));
  const names = Object.keys(forces).map((name) => [name, (DRIVERS[name] || [name])[0].replace(/ \[.*/, "")]);
  const driver = choice("over", names, (value) => update("driver", value));
  force.select.value = now.force;
  driver.select.value = now.driver;
  const models = Object.keys(forces[now.driver]);
  root.append(element("div", { class: "controls" }, force.node, driver.node), legend(models.map((model) => [model, MODELS[model]])), chart.node, words);
  update();
}

function showCurves(root, { horizon, floor, sigma, rmse, predicted_on: where }) {
  const models = Object.keys(rmse);
  const charts = CHANNELS.map(([name, words, factor], k) => {
    const times = (values) => values.map((value) => (value === null ? NaN : factor * value));
    const series = models.map((model) => ({ x: horizon, y: times(rmse[model][k]), kind: model, words: `${MODELS[model]}\ndiagnosis.nc: rmse, ${model}, ${name}` }));
    series.push({ x: horizon, y: times(floor[k]), kind: "floor", style: "dashed", words: `a right model\ndiagnosis.nc: floor, ${name}` });
    series.push({ x: horizon, y: horizon.map(() => factor * sigma[k]), kind: "reference", style: "dashed", words: `measurement noise\ndiagnosis.nc: sigma, ${name}` });
    return lineChart(230, `RMS error of ${words}`, () => ({ series, title: `RMS error of ${words}`, xLabel: "time ahead [s]", log: true })).node;
  });
  const entries = [...models.map((model) => [model, MODELS[model] || model]), ["floor", "a right model: noise floor", true], ["reference", "measurement noise", true]];
  root.append(legend(entries), element("div", { class: "columns" }, ...charts),
    element("p", { class: "source" }, `Open-loop predictions on ${where}. Source: diagnosis.nc, rmse, floor, sigma.`));
}

function showDiagnosis({ player, waterfall, explained, causes, forces, curves }) {
  const at = (name) => document.getElementById(name);
  if (at("waterfall"))
    at("waterfall").append(waterfallChart(waterfall, explained).node,
      element("p", { class: "source" }, "Effects that explain the same share it alike (Shapley 1953). Source: diagnosis.json, explained.share and causes.share."));
  showCauses(causes);
  if (at("player") && player && player.drives.length) new Player(at("player"), player);
  if (at("forces")) showForces(at("forces"), forces);
  if (at("curves")) showCurves(at("curves"), curves);
}
