"""Bench: speed of each part against a peer that does the same work on the same machine in the same run.

    driftjax bench                                everything: some minutes; the laps and the compilations take longest
    driftjax bench --only mpc simulator           these parts
    driftjax bench --quick                        every row once, small: to see that it runs

Each part is measured in a process of its own, with the number of threads that it is meant for. Measurements of the
two sides alternate; a row holds both medians with quartiles and the ratio of runs measured one after the other.
Writes results.json, results.md and the scaling figures.
"""
