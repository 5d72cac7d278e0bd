"""`dagmap tune`: parameters from a recording's resolution and noise, without truth."""

from .measuring import Measured as Measured
from .measuring import Points as Points
from .measuring import gather as gather
from .measuring import measure as measure
from .proposing import Proposed as Proposed
from .proposing import proposal as proposal
from .proposing import propose as propose
