"""Measurements of speed and memory: `insideout bench`."""

from ..threads import wait_without_spinning

wait_without_spinning()
