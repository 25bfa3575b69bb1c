"""Work in steps: run through at once, stopped, and as a part of more work."""

from __future__ import annotations

import pytest

from insideout.core.steps import part_of_work, run_through


class Work:
    """Three steps, of which one sees whether they were ended."""

    def __init__(self):
        self.closed = False

    def steps(self):
        try:
            yield from (0.0, 0.5, 1.0)
            return "made"
        finally:
            self.closed = True


def test_all_steps_at_once_give_the_result():
    heard = []
    assert run_through(Work().steps(), heard.append) == "made"
    assert heard == [0.0, 0.5, 1.0]


def test_a_stop_ends_the_work_before_the_error_is_handled():
    work = Work()

    def stop(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_through(work.steps(), stop)
    assert work.closed


def test_a_part_tells_its_share_of_the_whole():
    def whole():
        made = yield from part_of_work(Work().steps(), 0.2, 0.6)
        return made + " as a part"

    heard = []
    assert run_through(whole(), heard.append) == "made as a part"
    assert heard == pytest.approx([0.2, 0.4, 0.6])


def test_ending_the_whole_ends_the_part():
    work = Work()
    part = part_of_work(work.steps(), 0.0, 1.0)
    next(part)
    part.close()
    assert work.closed
