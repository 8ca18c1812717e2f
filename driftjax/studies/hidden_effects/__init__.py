"""Does `driftjax diagnose` find what is hidden? A bench of cars with random effects, drawn at run time.

    python -m experiments.hidden_effects                          about 500 cases, some hours on two cores
    python -m experiments.hidden_effects --single 20 --none 10 --quiet 0 ...   fewer
    python -m experiments.hidden_effects --case '{"condition": ...}'           one case again, as its line says
    python -m experiments.hidden_effects --resume --out DIR       go on

Conditions: nothing hidden, one effect (with process noise, without, and weak), two, one that is taken out of the
catalogue, and the CommonRoad simulators. Prints what was measured beside the targets, and every case that went wrong;
writes cases.jsonl, results.jsonl (a line per case as soon as it is done), score.json and figures.
"""
