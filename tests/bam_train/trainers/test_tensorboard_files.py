import resource
import threading

from bam_train.trainers.run_folder import TensorBoardFiles


def test_a_full_disk_ends_the_files_and_says_nothing(tmp_path, capfd):
    hook, limits = threading.excepthook, resource.getrlimit(resource.RLIMIT_FSIZE)
    files = TensorBoardFiles(tmp_path)
    files.write({"train/loss": 0.5}, 1)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    assert b"train/loss" in whole
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 9, limits[1]))
    try:
        for step in range(2, 50):
            files.write({"train/loss": 0.5}, step)
        files.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert threading.excepthook is hook
    assert capfd.readouterr() == ("", "")
