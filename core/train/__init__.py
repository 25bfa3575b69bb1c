"""Optimisation: parameters, losses, densification, schedules and the loop."""

from ..threads import wait_without_spinning

wait_without_spinning()
