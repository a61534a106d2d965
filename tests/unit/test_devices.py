"""What is attached is found without opening it."""

from pathlib import Path

from hardware.live.doctor import OWN, Device, Machine, _places, cameras, serial_ports


def test_cameras_are_read_from_the_kernels_list(tmp_path):
    (tmp_path / "video0").mkdir()
    (tmp_path / "video0" / "name").write_text("TacTip: USB Camera\n")
    (tmp_path / "video2").mkdir()
    assert cameras(tmp_path) == [Device("/dev/video0", "TacTip: USB Camera"), Device("/dev/video2", "camera")]


def test_no_camera_is_an_empty_list(tmp_path):
    assert cameras(tmp_path / "missing") == []


def test_serial_ports_are_listed():
    assert all(port.node for port in serial_ports())


def test_a_package_of_another_project_is_noticed():
    places = {"scenes": Path("/a"), "twin": Path("/a"), "training": Path("/b")}
    found = Machine({}, [], True, "", {}, places, None)
    assert any(line.startswith("MIXED") for line in found.lines()) and "training in /b" in found.lines()
    one = Machine({}, [], True, "", {}, dict.fromkeys(places, Path("/a")), Path("/kept"))
    assert "scenes, twin, training in /a" in one.lines() and "kept results /kept" in one.lines()


def test_a_diagnosis_ends_with_what_can_be_done():
    def verdict(packages: dict[str, str], can_render: bool, plain: str = "") -> str:
        return Machine(packages, [], can_render, plain, {}, {"twin": Path("/a")}, None).lines()[-1]

    assert verdict({"torch": "2.13"}, True).startswith("Ready:") and "plain" not in verdict({"torch": "2.13"}, True)
    assert "plain ones" in verdict({"torch": "2.13"}, True, "no EGL")
    assert verdict({"torch": ""}, False).startswith("Not ready:") and "way to render" in verdict({"torch": ""}, False)
    assert "torch" in verdict({"torch": ""}, True)


def test_the_packages_of_this_program_are_found():
    assert _places() == dict.fromkeys(OWN, Path(__file__).parents[2])
