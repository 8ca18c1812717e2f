"""Exact Gaussian processes of fixed, padded size: fit, predict, select informative data. Independent of cars."""

from driftjax.gp.any_kernel import KernelGP as KernelGP
from driftjax.gp.any_kernel import fit_kernel as fit_kernel
from driftjax.gp.dictionary import select_dictionary as select_dictionary
from driftjax.gp.fit import FitResult as FitResult
from driftjax.gp.fit import fit_gp as fit_gp
from driftjax.gp.fit import fit_masked as fit_masked
from driftjax.gp.model import GP as GP
from driftjax.gp.model import Hyper as Hyper
from driftjax.gp.model import bound_mean as bound_mean
from driftjax.gp.model import condition as condition
from driftjax.gp.model import data_scales as data_scales
from driftjax.gp.model import zero_gp as zero_gp
from driftjax.gp.orthogonal import predict_known_effects as predict_known_effects
from driftjax.gp.orthogonal import project_out as project_out
