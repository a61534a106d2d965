"""All that is live here touches a skin of few elements."""

import pytest
from coarse_skin import use_coarse_skin


@pytest.fixture(scope="module", autouse=True)
def coarse_skin():
    with pytest.MonkeyPatch.context() as patch:
        use_coarse_skin(patch)
        yield
