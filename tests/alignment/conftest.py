"""The cases that the layer is held to, as a fixture."""

import pytest
from probes import CASES, Layer


@pytest.fixture(params=CASES)
def layer(request) -> Layer:
    return CASES[request.param]()
