"""`RosbridgeLink` in forked and spawned processes, and at the end of a program."""

import json
import os
import subprocess
import sys
import textwrap

import pytest


def _run(python, server, code):
    return json.loads(python(textwrap.dedent(code), BAM_TEST_URL=server.url))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_child_makes_its_own_link_and_harms_no_other(python, scripted):
    texts = _run(
        python,
        scripted,
        """
        import json, os, warnings
        from bam_envs.rosbridge.client import RosbridgeLink
        from bam_envs.core.errors import InvalidValue

        def refusal(use):
            try:
                use()
            except InvalidValue as error:
                return str(error)

        url = os.environ["BAM_TEST_URL"]
        link = RosbridgeLink(url)
        link.connect()
        link.advertise("/cmd", "std_msgs/String")
        reading, writing = os.pipe()
        warnings.simplefilter("ignore", DeprecationWarning)
        if os.fork() == 0:
            refused = [
                refusal(lambda: link.publish("/cmd", {"data": "inherited"})),
                refusal(lambda: link.call("/x", "a/B", {}, 1.0)),
                refusal(lambda: link.subscribe("/cmd", "std_msgs/String", print)),
                refusal(link.connect),
            ]
            link.close()
            own = RosbridgeLink(url)
            own.connect()
            own.advertise("/cmd", "std_msgs/String")
            own.publish("/cmd", {"data": "child"})
            own.close()
            os.write(writing, json.dumps(refused).encode())
            os._exit(0)
        os.wait()
        link.publish("/cmd", {"data": "parent"})
        assert link.epoch == 1
        link.close()
        print(json.dumps([os.getpid(), json.loads(os.read(reading, 10000))]))
        """,
    )
    expected = (
        f"This link to {scripted.url} was made in process {texts[0]}, and this is a fork of it. "
        "Make and connect a link in the child itself."
    )
    assert texts[1] == [expected] * 4
    assert [frame["msg"]["data"] for frame in scripted.wait_for("publish", 2)] == ["child", "parent"]


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_each_connect_on_their_own(scripted, tmp_path, method):
    if method == "fork" and not hasattr(os, "fork"):
        pytest.skip("this system has no fork")
    program = tmp_path / "program.py"
    program.write_text(
        textwrap.dedent(
            f"""
            import multiprocessing, sys
            from bam_envs.rosbridge.client import RosbridgeLink

            def work(number):
                link = RosbridgeLink({scripted.url!r})
                link.connect()
                answer = link.call("/square", "a/B", {{"number": number}}, 10.0)["square"]
                link.close()
                return answer

            if __name__ == "__main__":
                with multiprocessing.get_context({method!r}).Pool(2) as pool:
                    print(pool.map(work, range(4), chunksize=1))
            """
        )
    )
    scripted.responses["/square"] = lambda args: {"square": args["number"] ** 2}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(
        [sys.executable, str(program)], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (result.stdout.strip(), result.returncode) == ("[0, 1, 4, 9]", 0), result.stderr


def test_a_program_that_forgets_to_close_ends(python, scripted):
    answer = _run(
        python,
        scripted,
        """
        import json, os
        from bam_envs.rosbridge.client import RosbridgeLink

        link = RosbridgeLink(os.environ["BAM_TEST_URL"], lost_after=1.0)
        link.connect()
        print(json.dumps(link.call("/rosapi/get_time", "rosapi/GetTime", {}, 5.0)))
        """,
    )
    assert answer == {"time": {"sec": 1000, "nanosec": 500_000_000}}
