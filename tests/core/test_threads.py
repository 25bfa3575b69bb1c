"""Idle threads sleep: other programs are running beside a reconstruction."""

import os
import subprocess
import sys

import pytest


def policy_after(module, **given):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"} | given
    code = f"import os, {module}; print(os.environ.get('OMP_WAIT_POLICY'))"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize("module", ["core.stages", "core.train.schedule", "core.render.kernels"])
def test_idle_threads_sleep(module):
    assert policy_after(f"insideout.{module}") == "PASSIVE"


def test_what_the_user_set_is_kept():
    assert policy_after("insideout.core.stages", OMP_WAIT_POLICY="ACTIVE") == "ACTIVE"


def test_the_pipeline_asks_for_it_before_torch_is_loaded():
    code = (
        "import sys\n"
        "from insideout.core.settings import stage_module\n"
        "class Watch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch':\n"
        "            import os; print(os.environ.get('OMP_WAIT_POLICY')); sys.exit()\n"
        "sys.meta_path.insert(0, Watch())\n"
        "import insideout.core.cli, insideout.core.worker, insideout.core.pipeline\n"
        "stage_module('surface')\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "PASSIVE"


@pytest.mark.parametrize("wanted", [True, False])
def test_a_short_loop_runs_alone_and_the_threads_are_back_afterwards(wanted):
    import numba

    from insideout.core.threads import Alone

    before = numba.get_num_threads()
    with Alone(wanted):
        assert numba.get_num_threads() == (1 if wanted else before)
    with pytest.raises(KeyError), Alone(wanted):
        raise KeyError
    assert numba.get_num_threads() == before
