"""Kinds of videos that are read wrong easily: each image of the file becomes the right frame, or is counted."""

from __future__ import annotations

import re
import shlex
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from video_files import encode, ffmpeg, psnr, smooth

from endoprior.core.checks import InputError
from endoprior.data.load import is_video
from endoprior.prepare.decoding import Timeline, usual_rate
from endoprior.prepare.source import open_source


def lowest_psnr(found, images):
    return min(psnr(image.rgb_u8, want) for image, want in zip(found, images, strict=True))


# --- Pixels


@pytest.mark.parametrize(("aspect", "shown"), [(Fraction(4, 3), 128), (Fraction(8, 9), 86), (Fraction(1), 96)])
def test_pixels_become_square(tmp_path, aspect, shown):
    images = smooth(3)
    source = open_source(encode(tmp_path / "a.mp4", images, sample_aspect_ratio=aspect))
    found = list(source)
    assert (source.width, source.height) == found[0].rgb_u8.shape[1::-1] == (shown, 64)
    back = cv2.resize(found[0].rgb_u8, (96, 64), interpolation=cv2.INTER_AREA)
    assert psnr(back, images[0]) > 25
    said = [f"a.mp4: pixels are not square ({aspect.numerator}:{aspect.denominator}); 96x64 px become {shown}x64 px"]
    assert source.notes == (said if shown != 96 else [])


def test_an_impossible_pixel_aspect_is_ignored_and_said(tmp_path):
    source = open_source(encode(tmp_path / "a.mp4", smooth(3), sample_aspect_ratio=Fraction(8, 1)))
    said = "a.mp4: the stated aspect ratio of pixels is not plausible and is ignored"
    assert source.width == 96 and source.notes == [said]


def test_high_dynamic_range_that_only_the_images_tell_is_said(tmp_path):
    """Some programs write the levels into the images, and "unknown" into the container."""
    colors = "colorprim=bt2020:transfer=smpte2084:colormatrix=bt2020nc"
    encoder = ["-vf", "setparams=colorspace=bt2020nc", "-c:v", "libx264", "-pix_fmt", "yuv420p10le"]
    encoder += ["-x264-params", colors]
    notes = open_source(ffmpeg("-i", encode(tmp_path / "a.mp4", smooth(4)), *encoder, tmp_path / "h.mkv")).notes
    assert len(notes) == 1 and notes[0].startswith("h.mkv: HDR video (PQ) is read as ordinary video")


@pytest.mark.parametrize(("transfer", "name"), [("smpte2084", "PQ"), ("arib-std-b67", "HLG"), ("bt709", "")])
@pytest.mark.parametrize("ending", ["mp4", "mkv", "ts"])
def test_video_of_high_dynamic_range_is_said(tmp_path, transfer, name, ending):
    colors = f"setparams=color_trc={transfer}:color_primaries=bt2020:colorspace=bt2020nc"
    encoder = ["-c:v", "libx264", "-pix_fmt", "yuv420p10le"]
    video = ffmpeg("-i", encode(tmp_path / "a.mp4", smooth(4)), "-vf", colors, *encoder, tmp_path / f"h.{ending}")
    notes = open_source(video).notes
    assert len(notes) == bool(name)
    for note in notes:
        assert note.startswith(f"h.{ending}: HDR video ({name}) is read as ordinary video")
        words = shlex.split(note.split("`")[1])
        assert words[0] == "ffmpeg"
        usual = open_source(ffmpeg(*words[1:]))
        assert len(list(usual)) == 4 and usual.notes == []


@pytest.mark.parametrize("turned", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [(), ("hflip",), ("vflip",), ("hflip", "vflip")])
def test_images_are_mirrored_and_turned_as_players_show_them(tmp_path, turned, mirrored):
    stored = encode(tmp_path / "stored.mp4", smooth(4))
    options = ["-display_rotation", str(turned), *(f"-display_{each}" for each in mirrored)]
    video = ffmpeg(*options, "-i", stored, "-c", "copy", tmp_path / "shown.mp4")
    want = list(open_source(ffmpeg("-i", video, "-c:v", "ffv1", "-pix_fmt", "bgr0", tmp_path / "want.mkv")))
    source = open_source(video)
    found = list(source)
    assert (source.width, source.height) == ((64, 96) if turned in (90, 270) else (96, 64))
    assert lowest_psnr(found, [image.rgb_u8 for image in want]) > 40
    said = "shown.mp4: 4 images are stored mirrored; they are used as the file says that they are shown"
    assert source.notes == ([said] if len(mirrored) == 1 else [])
    small = [image(source.width, source.height) for _, image in source.quick_images()]
    assert psnr(small[0], want[0].rgb_u8) > 30


@pytest.mark.parametrize("first", ["tff", "bff"])
def test_interlaced_images_are_not_combed(tmp_path, first):
    fields = [cv2.GaussianBlur(image, (0, 0), 2) for image in smooth(24, step=3)]
    woven = []
    for early, late in zip(fields[::2], fields[1::2], strict=True):
        woven.append(early.copy())
        part = np.s_[1::2] if first == "tff" else np.s_[::2]
        woven[-1][part] = late[part]
    options = {"crf": "8", "flags": "+ilme+ildct", "x264-params": f"{first}=1"}
    source = open_source(encode(tmp_path / "i.mp4", woven, options=options, pixels="yuv444p"))
    found = [image.rgb_u8 for image in source]
    assert len(found) == 12
    for image, combed, *times in zip(found[1:-1], woven[1:-1], fields[2:-2:2], fields[3:-2:2], strict=True):
        assert max(psnr(image, field) for field in times) > max(psnr(combed, field) for field in times) + 10
    assert source.notes == ["i.mp4: 12 images are interlaced; one field of each is used, with its rows filled"]
    source.weave = True  # rows of two cameras
    assert psnr(next(iter(source)).rgb_u8, woven[0]) > 35


def test_the_bits_in_use_fill_the_range(tmp_path):
    images = smooth(3)
    for bits in (8, 10, 12, 16):
        folder = tmp_path / str(bits)
        folder.mkdir()
        for index, image in enumerate(images):
            stored = image if bits == 8 else image.astype(np.uint16) << (bits - 8)
            cv2.imwrite(str(folder / f"{index}.png"), stored[..., ::-1])
        source = open_source(folder)
        assert all(np.array_equal(image.rgb_u8, want) for image, want in zip(source, images, strict=True))
        what = f"{bits}: images of 16 bits a channel: {bits} of 16 bits are in use, which become 0 to 255"
        assert source.notes == ([what] if bits > 8 else [])

    (tmp_path / "some").mkdir()
    for index, level in enumerate([600, 600, 65535]):  # the brightest image decides
        cv2.imwrite(str(tmp_path / f"some/{index}.png"), np.full((32, 32, 3), level, np.uint16))
    assert [int(image.rgb_u8[0, 0, 0]) for image in open_source(tmp_path / "some")] == [2, 2, 255]


# --- Time


def test_joined_streams_follow_each_other(tmp_path):
    images = smooth(30)
    for ending, codec, options in (("ts", "libx264", {"crf": "10", "g": "6"}), ("mpg", "mpeg2video", {"b": "4000000"})):
        for shortest in (10, 20):
            parts = [
                encode(tmp_path / f"{i}.{ending}", part, codec, options=options)
                for i, part in enumerate((images[:shortest], images[shortest:]))
            ]
            both = tmp_path / f"both.{ending}"
            both.write_bytes(b"".join(part.read_bytes() for part in parts))
            source = open_source(both)
            found = list(source)
            assert [image.seconds for image in found] == pytest.approx(np.arange(30) / 25)
            assert lowest_psnr(found, images) > 25 and not any(image.damaged for image in found)
            said = f"both.{ending}: joined of 2 parts, each with times of its own; they follow each other"
            assert said in source.notes
            assert len(source.times) == 30 and source.seconds == pytest.approx(30 / 25)


@pytest.mark.parametrize(
    ("ending", "codec", "used", "first"),
    [
        ("mp4", "libx264", 5, "the first is"),
        ("flv", "libx264", 5, "the first is"),
        ("wmv", "wmv2", 5, "the first is"),
        ("mkv", "libx264", 11, "the first 2 are"),
    ],
)
def test_joined_files_that_are_not_read_are_named(tmp_path, ending, codec, used, first):
    parts = [encode(tmp_path / f"{i}.{ending}", smooth(5 + i), codec, options={"b": "9000000"}) for i in range(3)]
    joined = tmp_path / f"all.{ending}"
    joined.write_bytes(b"".join(part.read_bytes() for part in parts))
    source = open_source(joined)
    assert len(list(source)) == used
    assert f"all.{ending}: of 3 joined files only {first} used; join them with `ffmpeg -f concat`" in source.notes
    assert not any("joined files" in note for note in open_source(parts[0]).notes)


@pytest.mark.parametrize("starts", [(0, 1, 0, 1), (0, 1, 0.5, 2), (0, 1, 40, 41)])
def test_times_of_fragments_that_start_again_lose_no_image(tmp_path, starts):
    images = smooth(24)
    whole = encode(tmp_path / "w.mp4", images, options={"crf": "10", "g": "6"}, max_b_frames=0)
    moved = ffmpeg("-i", whole, "-c", "copy", "-movflags", "frag_keyframe+empty_moov", tmp_path / "f.mp4")
    content = bytearray(moved.read_bytes())
    places = [found.end() + 4 for found in re.finditer(b"tfdt", content)]  # behind version and flags: 8 bytes
    length = int.from_bytes(content[places[1] : places[1] + 8], "big")
    for place, start in zip(places, starts, strict=True):
        content[place : place + 8] = int(start * length).to_bytes(8, "big")
    moved.write_bytes(content)
    found = list(open_source(moved))
    assert lowest_psnr(found, images) > 25
    assert min(np.diff([image.seconds for image in found])) > 0.039


def test_images_that_a_folder_has_besides_are_counted(tmp_path):
    for index, image in enumerate(smooth(3)):
        assert cv2.imwritemulti(str(tmp_path / f"{index}.tif"), [image, image, image])
    (tmp_path / "x.webp").touch()
    source = open_source(tmp_path)
    assert len(list(source)) == 3 and source.notes == [
        f"{tmp_path.name}: 1 images of other kinds (.webp) are not used",
        f"{tmp_path.name}: only the first image of each TIFF is used; 6 more are not",
    ]


def test_a_pause_keeps_the_frame_rate_and_all_images(tmp_path):
    times = [*range(12), *range(400, 412)]
    source = open_source(encode(tmp_path / "pause.mp4", smooth(24), times=times))
    assert source.frames_per_second == pytest.approx(25)
    assert source.times == pytest.approx(np.array(times) / 25)
    assert [image.seconds for image in source] == pytest.approx(np.array(times) / 25)


@pytest.mark.parametrize(
    ("stamps", "repeated"),
    [
        ([80 * (i // 2) for i in range(20)], 10),
        ([120 * (i // 3) for i in range(20)], 13),
        ([40 * (i - (i % 5 == 4)) for i in range(20)], 4),
        ([40 * i for i in range(18)] + [40 * 17] * 2, 2),
    ],
)
def test_time_stamps_that_repeat_are_no_parts(tmp_path, stamps, repeated):
    images, base = smooth(20), Fraction(1, 1000)
    with av.open(str(tmp_path / "r.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "bgr0"
        for image, stamp in zip(images, stamps, strict=True):
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                packet.pts = packet.dts = stamp
                packet.time_base, packet.stream = base, stream
                container.mux(packet)
    source = open_source(tmp_path / "r.mkv")
    found = list(source)
    assert lowest_psnr(found, images) > 25 and source.frames_per_second == pytest.approx(25)
    assert [image.seconds for image in found] == pytest.approx(np.arange(20) / 25) == source.times
    assert source.notes == [f"r.mkv: {repeated} time stamps repeat the one before; such images are spread in time"]


def test_times_only_increase_but_for_single_ones_in_disorder():
    def along(times):
        line = Timeline(1.0)
        return [round(time, 6) for _, time in line.along((None, time) for time in times)], line.restarts, line.misplaced

    assert along([0, 1, 2, 3]) == ([0, 1, 2, 3], 0, 0)
    assert along([7, 8, 0, 1, 2, 0, 1]) == ([7, 8, 9, 10, 11, 12, 13], 2, 0)
    assert along([0, 1, 5, 2, 6]) == ([0, 1, 5, 2, 6], 0, 1)
    assert along([0, 1, 2, 1.5, 3]) == ([0, 1, 2, 1.5, 3], 0, 1)
    assert along([None, None, None]) == ([0, 1, 2], 0, 0)
    assert along([0, 0, 0]) == ([0, 1, 2], 0, 0)
    assert along([0, 1, 1, 2]) == ([0, 1, 1.5, 2], 0, 0)
    assert along([0, 1, 1, 0, 0, 1]) == ([0, 1, 2, 3, 3.5, 4], 1, 0)
    assert along([0] * 40 + [40, 41]) == (list(range(42)), 0, 0)  # more than are held in memory
    assert along([0] * 40 + [20, 21]) == (list(range(42)), 0, 0)
    assert along([0, 0, 100, 101]) == ([0, 1, 100, 101], 0, 0)  # a pause


def test_the_usual_rate_is_that_of_most_steps():
    assert usual_rate(np.arange(9) / 25, [12.0]) == pytest.approx(25)
    assert usual_rate(np.round(np.arange(90) / 30 * 1.001, 3), [30000 / 1001]) == 30000 / 1001  # a file counts ms
    assert usual_rate([0, 0.04, 9.0, 9.04, 0.0, 0.04], [0.5]) == pytest.approx(25)
    assert usual_rate([0.0, 0.0, 0.08, 0.08, 0.16, 0.16, 0.24], [12.5]) == pytest.approx(25)
    assert usual_rate([0.0, 0.04, 0.08, 0.08, 0.16, 0.2], []) == pytest.approx(25)
    assert usual_rate([], [600.0]) == 600 and usual_rate([], []) == usual_rate([0.0], [1e9]) == 25


# --- Damage


def test_damage_is_known_up_to_the_next_key_frame(tmp_path):
    images = smooth(24, 96, 128)
    whole = encode(tmp_path / "whole.ts", images, options={"crf": "14", "g": "12", "bf": "0"})
    content = whole.read_bytes()
    packets = [content[i : i + 188] for i in range(0, len(content), 188)]
    kept = [packet for i, packet in enumerate(packets) if not 0.3 < i / len(packets) < 0.4]
    (tmp_path / "lost.ts").write_bytes(b"".join(kept))
    source = open_source(tmp_path / "lost.ts")
    list(source)
    assert source.was_damaged
    found = list(source)  # by one thread
    quality = {round(image.seconds * 25): psnr(image.rgb_u8, images[round(image.seconds * 25)]) for image in found}
    damaged = {round(image.seconds * 25) for image in found if image.damaged}
    assert damaged and max(damaged) < 12 and all(q > 25 for at, q in quality.items() if at not in damaged)
    assert not open_source(whole).was_damaged and not any(image.damaged for image in open_source(whole))


def test_an_image_that_cannot_be_decoded_does_not_end_the_video(tmp_path):
    images = smooth(12)
    path = encode(tmp_path / "a.mov", images, "png", "rgb24")
    content = bytearray(path.read_bytes())
    places = [i for i in range(len(content)) if content[i : i + 4] == b"\x89PNG"]
    content[places[5] : places[5] + 8] = bytes(8)
    path.write_bytes(content)
    source = open_source(path)
    list(source)
    assert source.was_damaged
    found = list(source)  # by one thread
    assert [round(image.seconds * 25) for image in found] == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert np.array_equal(found[5].rgb_u8, images[6])
    assert "a.mov: damaged images that cannot be decoded and are left out: 1" in source.notes


# --- Tracks and files


def tracks(path, *sizes):
    """A video with a track for each (width, height, number of images)."""
    with av.open(str(path), "w") as container:
        streams = []
        for width, height, count in sizes:
            stream = container.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append((stream, smooth(count, height, width)))
        for stream, images in streams:
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
    return path


def test_the_track_of_the_video_is_used(tmp_path):
    source = open_source(tracks(tmp_path / "a.mp4", (80, 64, 24), (160, 128, 24)))
    assert (source.width, len(list(source))) == (160, 24)
    said = "only one is used (160x128 px, 24 images), not: 80x64 px, 24 images"
    assert source.notes == [f"a.mp4: of 2 video tracks, {said}"]
    name = "two eyes.mp4"
    first, hint = open_source(tracks(tmp_path / name, (96, 64, 9), (96, 64, 9))).notes
    assert first == f"{name}: of 2 video tracks, only one is used (96x64 px, 9 images), not: 96x64 px, 9 images"
    words = shlex.split(hint.split("`")[1])
    assert words[:1] == ["ffmpeg"] and ffmpeg(*words[1:]).name == "two eyes_right.mp4"
    assert len(list(open_source(tmp_path / "two eyes_right.mp4"))) == 9
    assert hint.endswith(f"then add `--right '{tmp_path / 'two eyes_right.mp4'}'`")
    assert open_source(tracks(tmp_path / "b.mp4", (320, 256, 1), (160, 128, 24))).width == 160  # a cover
    assert open_source(tracks(tmp_path / "c.mp4", (320, 256, 4), (160, 128, 24))).width == 160  # a preview


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [("a.y4m", "wrapped_avframe", "yuv444p"), ("a.mjpeg", "mjpeg", "yuvj444p"), ("a.apng", "apng", "rgb24")],
)
def test_plain_streams_of_images_are_videos(tmp_path, name, codec, pixels):
    images = smooth(6)
    path = encode(tmp_path / name, images, codec, pixels)
    assert is_video(path)
    assert lowest_psnr(list(open_source(path)), images) > 28


def test_an_animated_webp_is_a_video(tmp_path):
    images = smooth(6)
    path = tmp_path / "a.webp"
    first, *others = map(Image.fromarray, images)
    first.save(path, save_all=True, append_images=others, duration=[40, 40, 200, 40, 40, 40], lossless=True)
    assert is_video(path)
    source = open_source(path)
    found = list(source)
    assert all(np.array_equal(image.rgb_u8, want) for image, want in zip(found, images, strict=True))
    assert [image.seconds for image in found] == pytest.approx([0, 0.04, 0.08, 0.28, 0.32, 0.36])
    assert source.frames_per_second == pytest.approx(25)


def test_an_animated_webp_without_durations_has_the_usual_rate(tmp_path):
    first, *others = map(Image.fromarray, smooth(6))
    first.save(tmp_path / "a.webp", save_all=True, append_images=others, duration=0, lossless=True)
    source = open_source(tmp_path / "a.webp")
    assert [image.seconds for image in source] == pytest.approx([k / 25 for k in range(6)])
    assert source.frames_per_second == 25 and source.seconds == pytest.approx(6 / 25)


@pytest.mark.parametrize("name", ["a.mov", "a.webp", "a.gif"])
def test_transparent_parts_of_videos_are_said(tmp_path, name):
    images = [np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]) for image in smooth(4)]
    for image in images[:3]:
        image[:20, :20, 3] = 0
    first, *others = map(Image.fromarray, images)
    if name == "a.mov":
        for index, image in enumerate(images):
            Image.fromarray(image).save(tmp_path / f"{index}.png")
        ffmpeg("-i", tmp_path / "%d.png", "-c:v", "png", "-pix_fmt", "rgba", tmp_path / name)
    else:
        first.save(tmp_path / name, save_all=True, append_images=others, lossless=True, duration=40, disposal=2)
    source = open_source(tmp_path / name)
    assert len(list(source)) == 4
    assert f"{name}: 3 images have transparent parts; their color is used there, whatever it is" in source.notes


def test_what_is_no_video_is_named(tmp_path):
    (tmp_path / "a.m3u8").write_text("#EXTM3U\n#EXTINF:4,\nhttp://localhost/a.ts\n")
    (tmp_path / "a.ffconcat").write_text("ffconcat version 1.0\nfile /etc/hostname\n")
    cv2.imwrite(str(tmp_path / "a.png"), smooth(1)[0])
    for name, what in (("a.m3u8", "a playlist"), ("a.ffconcat", "a playlist"), ("a.png", "one image")):
        with pytest.raises(InputError, match=rf"{name}: expected a video file, got {what}"):
            open_source(tmp_path / name)
