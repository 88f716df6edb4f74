import gc
import weakref

import pytest

from bam_train.loop import Workspace


@pytest.mark.parametrize("window", [None, 3])
def test_a_workspace_is_freed_at_once(kind, window):
    """A workspace an epoch is the usual form: they must not wait for the garbage collector. A window's may."""
    gc.collect()
    gc.disable()
    try:
        workspace = Workspace(window=window)
        workspace.set("a", 0, kind([1.0]))
        reference = weakref.ref(workspace)
        del workspace
        assert (reference() is None) == (window is None)
    finally:
        gc.enable()
