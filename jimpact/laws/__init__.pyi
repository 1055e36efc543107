"""Names of the laws for those who write rooms."""

from jimpact.core.registry import REGISTRY as REGISTRY, Row as Row, register as register

from .gap_scale import DELTA_C as DELTA_C, gap_scale as gap_scale
from .histories import History as History
from .impulse_correlation import interval as interval
from .lzb import default_rtol as default_rtol
