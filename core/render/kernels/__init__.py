"""The renderers, once for each kind of machine."""

from ...memory import keep_freed_memory
from ...threads import wait_without_spinning

wait_without_spinning()
keep_freed_memory()
