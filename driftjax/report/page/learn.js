// The page of `driftjax learn`.

function showLearn({ player, results, labels, kinds, controllers }) {
  const root = document.getElementById("player");
  if (root) new Player(root, player);
  const curve = document.getElementById("curve");
  if (!curve) return;
  curve.append(
    legend([["other", "compared with"], ["nominal", "nominal model"], ["gpr", "with the learnt GP"], ["explored", "exploration"]]),
    learningCurve(results, labels, kinds, controllers).node,
    element("p", { class: "source" }, "Dot: mean over plants; bar: 95 % interval, of three plants or more; rings: plants; what reaches below the axis is cut. Source: results.json, stages, lateral_error."));
}
