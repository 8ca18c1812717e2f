"""Shared records, solver results, integrators and config files; imports nothing of the layers above."""

from driftjax.core.atomic import write_atomically as write_atomically
from driftjax.core.atomic import write_text as write_text
from driftjax.core.config import find_config as find_config
from driftjax.core.config import flatten_config as flatten_config
from driftjax.core.config import from_dict as from_dict
from driftjax.core.config import merge_config as merge_config
from driftjax.core.config import require as require
from driftjax.core.config import require_at_least as require_at_least
from driftjax.core.config import require_positive as require_positive
from driftjax.core.config import set_option as set_option
from driftjax.core.errors import BadInput as BadInput
from driftjax.core.integrate import lag_step as lag_step
from driftjax.core.integrate import markov_step as markov_step
from driftjax.core.integrate import rk4_loop as rk4_loop
from driftjax.core.integrate import rk4_step as rk4_step
from driftjax.core.records import Control as Control
from driftjax.core.records import State as State
from driftjax.core.records import as_float as as_float
from driftjax.core.records import features as features
from driftjax.core.results import RESULTS as RESULTS
from driftjax.core.yamlfile import read_yaml as read_yaml
from driftjax.core.yamlfile import shown as shown
from driftjax.core.yamlfile import written_float as written_float
from driftjax.environment import dispatch_inline

dispatch_inline()
