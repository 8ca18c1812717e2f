"""Active exploration: candidate corner speeds (V-sets) and selection of the next one (Algorithm 1)."""

from driftjax.explore.select import select as select
from driftjax.explore.speed_sets import v_sets as v_sets
