"""Each layout of a calibration gives the same numbers; a broken one is a problem with a sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.calibration import read_stereo_calibration
from gsplat_core.io.recordings.plain_files import Findings

K1 = [[300.0, 0.0, 150.0], [0.0, 302.0, 130.0], [0.0, 0.0, 1.0]]
K2 = [[305.0, 0.0, 170.0], [0.0, 304.0, 126.0], [0.0, 0.0, 1.0]]
D1, D2 = [-0.1, 0.05, 0.001, -0.002], [-0.08, 0.02, 0.0, 0.001]
R = [[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]]
T = [-4.0, 0.1, 0.2]


def rows(matrix):
    return "; ".join(" ".join(f"{each:e}" for each in row) for row in matrix)


def matlab(folder):
    (folder / "calibration.m").write_text(
        f"%% [1 2 3]\nIntrinsicMatrixLeft = transpose([{rows(K1)}]); % left\nIntrinsicMatrixRight = transpose([ {rows(K2)} ]);\n"
        f"rotationOfCameraMatrix = [{rows(R)}];\ntranslationOfCameraMatrix = [{rows([T])}];\n"
        f"radialDistortionLeft = [{D1[0]} {D1[1]}];\nradialDistortionRight = [{D2[0]} {D2[1]}];\n"
        f"tangentialDistortionLeft = [{D1[2]} {D1[3]}];\ntangentialDistortionRight = [{D2[2]} {D2[3]}];\n"
        "stereoParams = stereoParameters(a, b, rotationOfCameraMatrix, translationOfCameraMatrix);\n"
    )


def scared_json(folder):
    content = {"KL": K1, "KR": K2, "DL": [D1], "DR": [D2], "R": R, "T": [[each] for each in T]}
    (folder / "calibration.json").write_text(json.dumps({"camera-calibration": content, "camera-pose": []}))


def ini(folder):
    def eye(K, D):
        lens = [f"kc_{i}={value}" for i, value in enumerate([*D, 0, 0, 0, 0])]
        return [
            "res_x=320",
            "res_y=256",
            f"fc_x={K[0][0]}",
            f"fc_y={K[1][1]}",
            f"cc_x={K[0][2]}",
            f"cc_y={K[1][2]}",
            *lens,
        ]

    turn = [f"R_{i}={value}" for i, value in enumerate(np.ravel(R))] + [f"T_{i}={value}" for i, value in enumerate(T)]
    lines = ["[StereoLeft]", *eye(K1, D1), "[StereoRight]", *eye(K2, D2), *turn]
    (folder / "StereoCalibration.ini").write_text("\n".join(lines))


def hamlyn(folder):
    def lines(matrix):
        return "\n".join(" ".join(map(str, row)) for row in matrix) + "\n"

    (folder / "calib.left.intrinsic.txt").write_text(lines([*K1, D1]))
    (folder / "calib.right.intrinsic.txt").write_text(lines([*K2, D2]))
    pose = [[*row, away] for row, away in zip(R, T, strict=True)]
    (folder / "calib.l2r.4x4").write_text(lines([*pose, [0, 0, 0, 1]]))


def opencv_yaml(folder):
    def matrix(name, values):
        flat = np.ravel(values)
        return f"{name}: !!opencv-matrix\n   rows: 1\n   cols: {flat.size}\n   dt: d\n   data: [ {', '.join(map(str, flat))} ]\n"

    values = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": R, "T": T}
    text = "%YAML:1.0\n---\n" + "".join(matrix(name, value) for name, value in values.items())
    (folder / "stereo_calibration.yaml").write_text(text)


@pytest.mark.parametrize("write", [matlab, scared_json, ini, hamlyn, opencv_yaml])
def test_every_calibration_layout_reads_same_values(tmp_path, write):
    write(tmp_path)
    calibration, paths = read_stereo_calibration(tmp_path, Findings(strict=True))
    assert {path.name for path in paths} == {path.name for path in tmp_path.iterdir()}
    for found, wanted in (
        (calibration.left_K, K1), (calibration.right_K, K2), (calibration.rotation, R), (calibration.translation_mm, T),
        (calibration.left_distortion[:4], D1), (calibration.right_distortion[:4], D2),
    ):  # fmt: skip
        assert np.allclose(found, wanted)
    assert not calibration.left_distortion[4:].any()
    assert calibration.size in (None, (320, 256))


def test_stereo_calibration_is_none_without_file(tmp_path):
    assert read_stereo_calibration(tmp_path, Findings(strict=True)) is None


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("calibration.m", "disp(1)", "there is no radialDistortionLeft"),
        ("calibration.m", "IntrinsicMatrixLeft = [1 2 3];", "there is no radialDistortionLeft"),
        ("calibration.json", '{"camera-calibration": 3}', "is no object"),
        ("calibration.json", '{"KL": [[1, 2]]}', "KL has 2 numbers in place of 9"),
        ("calibration.json", "{", "it is not JSON"),
        ("StereoCalibration.ini", "[StereoLeft]\nfc_x=1", "there is no 'StereoRight'"),
        ("StereoCalibration.ini", "hello", "there is no"),
        ("calib.l2r.4x4", "1 2 3", "calib.left.intrinsic.txt|16|not there"),
        ("stereo_calibration.yaml", "M1: 3", "there is no M1"),
    ],
)
def test_invalid_stereo_calibration_file_is_refused(tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingInvalid, match=sentence):
        read_stereo_calibration(tmp_path, Findings(strict=True))


def test_stereo_calibration_with_swapped_eyes_is_refused(tmp_path):
    scared_json(tmp_path)
    path = tmp_path / "calibration.json"
    content = json.loads(path.read_text())
    content["camera-calibration"]["T"] = [4.0, 0.1, 0.2]
    path.write_text(json.dumps(content))
    with pytest.raises(RecordingInvalid, match="swap the eyes"):
        read_stereo_calibration(tmp_path, Findings(strict=True))


def test_oversized_stereo_calibration_file_is_refused(tmp_path):
    (tmp_path / "calibration.m").write_bytes(b" " * (2 << 20))
    with pytest.raises(RecordingInvalid, match="more than"):
        read_stereo_calibration(tmp_path, Findings(strict=True))
