"""Of faces none is searched for here: Triton's process starts sooner without their detector."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def _searched_once(): ...
