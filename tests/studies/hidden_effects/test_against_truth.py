"""What the search of a diagnosis made of the true effects: their scores, and the cost of the truth."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from diagnosis.recorded import ORDER, problem_of

from driftjax.diagnosis.fit import evaluate_fit, linearise
from driftjax.diagnosis.score import scores
from driftjax.studies.hidden_effects.against_truth import nominal_scores, penalised_costs


def test_a_hidden_effect_ranks_first_and_its_truth_costs_less_than_the_nominal_car():
    """A search that has named nothing."""
    problem = problem_of(31, 1, stiffness_front=-0.8)
    nominal = evaluate_fit(problem, np.zeros(len(ORDER)))
    at = scores(problem, linearise(problem, nominal), nominal.theta, (), 0)
    selection = SimpleNamespace(nominal_scores=at, fit=nominal, selected=())
    naming = SimpleNamespace(searched=problem, found=selection)
    evidence: Any = SimpleNamespace(problem=problem, selection=selection, naming=naming)
    content = nominal_scores(evidence, {"stiffness_front", "steer_lag"})
    assert set(content) == {"stiffness_front", "steer_lag"} and content["stiffness_front"]["rank"] == 0
    size = -0.8 * float(problem.model.scale[ORDER.index("stiffness_front")])
    costs = penalised_costs(evidence, {"stiffness_front": {"p": size}})
    assert costs["truth"] < costs["named"] - 20
    assert penalised_costs(evidence, {})["truth"] == costs["named"]
