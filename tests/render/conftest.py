"""Few pixels are rendered as for users, and no face is searched for: the process of Triton starts sooner."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def _started_and_searched_once(): ...
