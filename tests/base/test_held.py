"""A folder that several files are written into has one writer at a time."""

from threading import Thread

import pytest

from planner.base.errors import FileError
from planner.base.files import folder_lock, staged_folder


def test_a_folder_is_held_by_one_writer_and_free_after_a_kill(tmp_path):
    with folder_lock(tmp_path):
        with pytest.raises(FileError, match="another planner is writing into it") as error, folder_lock(tmp_path):
            pass
        assert ".planner-" not in str(error.value)  # the hidden names are our business
        with pytest.raises(FileError, match="another planner is writing into it"), staged_folder(tmp_path):
            pytest.fail("it began to work")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".planner-lock").touch()  # of a killed process: the file stays, its lock does not
    with folder_lock(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_of_many_writers_one_holds_the_folder_at_a_time(tmp_path):
    """Also where the lock's file is removed by one while another opens it."""
    inside, most, refused = [], [], []

    def work():
        for _ in range(200):
            try:
                with folder_lock(tmp_path):
                    inside.append(1)
                    most.append(len(inside))
                    inside.pop()
            except FileError:
                refused.append(1)

    threads = [Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert len(most) + len(refused) == 800
