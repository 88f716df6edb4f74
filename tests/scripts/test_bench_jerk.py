"""The benchmark of controllers runs, and trajectories are smoother than set points that are held."""


def test_figures(run_script, tmp_path):
    options = ("--episodes", 1, "--smoothing", 0.03, "--only", "held", "--only", "trajectory 1.5")
    done = run_script("bench_jerk", *options, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = {line[:26].strip(): line[36:].split() for line in done.stdout.splitlines()[1:] if "on time" in line}
    rms, _, lag, success = rows["trajectory 1.5"]
    assert float(rms) < float(rows["held"][0]) / 5
    assert 80 <= float(lag) <= 110
    assert success == "100%"
