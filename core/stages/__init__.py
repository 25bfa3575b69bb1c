"""The five stages of the paper, one module or folder each: `run`, `reason_to_skip`, `PRESETS`."""

from ..threads import wait_without_spinning

wait_without_spinning()
