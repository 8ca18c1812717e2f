"""Propose a column map: which column of a log is which channel, in which unit and with which sign."""

from driftjax.logs.guess.proposal import Guess as Guess
from driftjax.logs.guess.proposal import Guessed as Guessed
from driftjax.logs.guess.proposal import guess_columns as guess_columns
