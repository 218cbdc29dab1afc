"""Tests in a process of their own, as CasADi's libraries and OpenSim's cannot share one."""

import functools
import importlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec

import pytest


def apart(test):
    """Run a test whose arguments can be pickled beside the others, if there is a CasADi."""

    @functools.wraps(test)
    def run(**arguments):
        if find_spec("casadi") is None:
            pytest.skip("there is no CasADi")
        _pool().submit(_call, test.__module__, test.__name__, arguments).result()

    return run


@functools.cache
def _pool():
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def _call(module, name, arguments):
    getattr(importlib.import_module(module), name).__wrapped__(**arguments)
