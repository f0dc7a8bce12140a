import pytest

from tests.support.env_episodes import field_rig


@pytest.fixture(scope="session")
def field(tmp_path_factory):
    """The environments' default rig over a bare field, which is built quickly."""
    return field_rig(tmp_path_factory.mktemp("field"))
