"""The renderers, once for each kind of machine."""

from ...threads import wait_without_spinning

wait_without_spinning()
