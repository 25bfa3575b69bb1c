"""What a measurement says of the machine that it was made on."""

from insideout.core.bench.machine import machine, summary


def test_the_cores_and_those_of_them_that_were_used_are_told():
    facts = machine() | {"cores": 8, "threads": 8}
    assert ", 8 cores, " in summary(facts)
    assert ", 8 cores (2 used), " in summary(facts | {"threads": 2})
    assert ", 1 core, " in summary(facts | {"cores": 1, "threads": 1})


def test_tables_of_before_threads_were_noted_can_still_be_read():
    facts = {key: value for key, value in machine().items() if key != "threads"}
    assert " core" in summary(facts)
