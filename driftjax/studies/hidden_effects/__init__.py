"""Study of hidden effects: does `driftjax diagnose` name them? Cars with random effects, drawn at run time.

    python -m experiments.hidden_effects                          about 500 cases, hours on two cores
    python -m experiments.hidden_effects --single 20 --none 10 --quiet 0 ...   fewer
    python -m experiments.hidden_effects --case '{"condition": ...}'           repeat one case, a line of cases.jsonl
    python -m experiments.hidden_effects --resume --out DIR       continue

Conditions: nothing hidden, one effect (with process noise, without, and weak), two, one that is missing from the
catalogue, and the CommonRoad simulators. Prints the measures with their targets and every failed case; writes
cases.jsonl, results.jsonl (a line per finished case), score.json and figures.
"""
