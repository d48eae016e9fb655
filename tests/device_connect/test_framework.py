"""The framework's package runs when one of its names is used, in a process of its own."""

import subprocess
import sys
import textwrap

import pytest

PRELUDE = "import sys\nfrom strands_robots.device_connect import load_when_used\n"


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + textwrap.dedent(code)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_client_loads_the_messaging_package_alone():
    loaded = run("""
        load_when_used()
        import strands_robots.device_connect.client, strands_robots.device_connect.backends.zenoh
        print("device_connect_edge.messaging" in sys.modules, "device_connect_edge.device" in sys.modules)
    """)
    assert loaded == "True False"


@pytest.mark.parametrize(
    "use",
    [
        "from device_connect_edge import DeviceRuntime",
        "import device_connect_edge; device_connect_edge.DeviceRuntime",
        "from device_connect_edge import *; DeviceRuntime",
        "from device_connect_edge.device import DeviceRuntime",
        "from device_connect_edge.drivers import DeviceDriver, rpc",
    ],
)
def test_every_import_of_the_framework_works_after_its_messaging_package(use):
    same = f"""
        load_when_used()
        import device_connect_edge.messaging
        {use}
        import device_connect_edge
        print(device_connect_edge.DeviceRuntime.__module__, device_connect_edge.messaging.create_client.__name__)
    """
    assert run(same) == "device_connect_edge.device create_client"


def test_absent_name_is_an_attribute_error():
    said = run("""
        load_when_used()
        import device_connect_edge
        try:
            device_connect_edge.nothing
        except AttributeError as error:
            print(error)
    """)
    assert "nothing" in said


def test_package_that_is_loaded_stays_as_it_is():
    assert (
        run("""
        import device_connect_edge as before
        load_when_used()
        print(sys.modules["device_connect_edge"] is before)
    """)
        == "True"
    )
