"""The same request gives the same coupling file, byte for byte, whatever else the machine does."""

import pytest
from tools.same_designs import QUICK, files


@pytest.mark.parametrize("name", list(QUICK))
def test_load_and_cores_change_no_byte(name, tmp_path):
    """A design under two busy processes, and on one core: `make kernels` compares more designs in more ways."""
    found = files(QUICK[name], tmp_path, quick=True)
    assert len(found) == 2
    assert len(set(found.values())) == 1
