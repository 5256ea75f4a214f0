import pytest
from cases_web import software_chromium


@pytest.fixture(scope="module")
def browser():
    with software_chromium() as opened:
        yield opened
