"""What is attached is found without opening it."""

from hardware.doctor import Device, cameras, serial_ports


def test_cameras_are_read_from_the_kernels_list(tmp_path):
    (tmp_path / "video0").mkdir()
    (tmp_path / "video0" / "name").write_text("TacTip: USB Camera\n")
    (tmp_path / "video2").mkdir()
    assert cameras(tmp_path) == [Device("/dev/video0", "TacTip: USB Camera"), Device("/dev/video2", "camera")]


def test_no_camera_is_an_empty_list(tmp_path):
    assert cameras(tmp_path / "missing") == []


def test_serial_ports_are_listed():
    assert all(port.node for port in serial_ports())
