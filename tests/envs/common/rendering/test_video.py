"""Files that are written can be read again."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from torchrl_her_envs import make_env, record_episodes, write_video
from torchrl_her_envs.common.rendering import video


def squares(count: int, *, height: int = 40, width: int = 60) -> list[Tensor]:
    """Frames in which an orange square moves on by two pixels each time."""
    frames = torch.full((count, height, width, 3), 250, dtype=torch.uint8)
    for index, frame in enumerate(frames):
        frame[10:20, 2 * index : 2 * index + 10] = torch.tensor([240, 130, 50], dtype=torch.uint8)
    return list(frames)


def test_a_gif_has_the_frames_and_the_size(tmp_path):
    path = write_video(squares(7), tmp_path / "new" / "film.gif", fps=20)
    with Image.open(path) as gif:
        assert path == tmp_path / "new" / "film.gif"
        assert (gif.n_frames, gif.size) == (7, (60, 40))
        assert gif.info["duration"] == 50  # milliseconds
        assert gif.info["loop"] == 0  # for ever


def test_a_gif_keeps_the_colors(tmp_path):
    with Image.open(write_video(squares(5), tmp_path / "film.gif")) as gif:
        gif.seek(4)
        last = gif.convert("RGB")
    assert last.getpixel((12, 15)) == (240, 130, 50)
    assert last.getpixel((4, 15)) == (250, 250, 250)  # where the square was


def test_a_small_thing_keeps_its_color_beside_large_ones(tmp_path):
    frame = torch.randint(200, 256, (200, 200, 3), dtype=torch.uint8)
    frame[90:94, 90:94] = torch.tensor([20, 15, 30], dtype=torch.uint8)
    with Image.open(write_video([frame], tmp_path / "film.gif")) as gif:
        pixel = gif.convert("RGB").getpixel((92, 92))
    assert max(pixel) < 60


def test_a_film_of_eight_episodes_stays_small(tmp_path):
    env = make_env("hand_v0", num_envs=8)
    path = write_video(record_episodes(env, env.rand_action, size=240), tmp_path / "film.gif")
    assert path.stat().st_size < 1_500_000


@pytest.mark.parametrize(("height", "width"), [(48, 64), (41, 63)])
def test_an_mp4_has_the_frames_and_even_sides(tmp_path, height, width):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = write_video(squares(6, height=height, width=width), str(tmp_path / "film.MP4"), fps=10)
    assert ffmpeg.count_frames_and_secs(path) == (6, pytest.approx(0.6))
    command = [ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(6, height + height % 2, width + width % 2, 3)
    assert abs(pictures[-1, 15, 14].astype(int) - [240, 130, 50]).max() < 40


class WithoutPlugin:
    def get_writer(self, *args: object, **options: object) -> None:
        raise ImportError("no ffmpeg here")


@pytest.mark.parametrize("module", [None, WithoutPlugin()])
def test_an_mp4_needs_the_extra(tmp_path, monkeypatch, module):
    monkeypatch.setattr(video, "imageio", module)
    with pytest.raises(ImportError, match=r'writing an MP4 needs the extra "video": pip install'):
        write_video(squares(2), tmp_path / "film.mp4")


def test_another_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"cannot write 'film.avi': its suffix must be one of \.gif, \.mp4"):
        write_video(squares(2), tmp_path / "film.avi")


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], r"a video needs frames, all of one shape, got 0 of shapes \[\]"),
        ([*squares(1), *squares(1, width=50)], r"got 2 of shapes \[\(40, 50, 3\), \(40, 60, 3\)\]"),
    ],
)
def test_frames_that_make_no_video(tmp_path, frames, message):
    with pytest.raises(ValueError, match=message):
        write_video(frames, tmp_path / "film.gif")


def test_a_rate_must_be_positive(tmp_path):
    with pytest.raises(ValueError, match="fps must be above 0, got 0"):
        write_video(squares(2), tmp_path / "film.gif", fps=0)


def test_a_film_that_cannot_be_written_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(_frames, path, _fps):
        path.write_bytes(b"half of it")
        raise OSError("no space left")

    frames = [torch.zeros(8, 8, 3, dtype=torch.uint8)]
    write_video(frames, tmp_path / "film.gif")
    before = (tmp_path / "film.gif").read_bytes()
    monkeypatch.setitem(video._WRITERS, ".gif", fail)
    with pytest.raises(OSError, match="no space left"):
        write_video(frames, tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]
