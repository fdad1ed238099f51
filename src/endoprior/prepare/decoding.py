"""Decode a video file image by image: which track, when each image is shown, which are damaged, no combed rows."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import groupby, islice, pairwise, tee, zip_longest
from typing import TypeVar, cast

import av
import numpy as np
from av.container import InputContainer
from av.error import BlockingIOError, EOFError, FFmpegError
from av.filter import Graph
from av.sidedata.sidedata import SideDataContainer
from av.video.stream import VideoStream

AVI = "avi"  # FFmpeg's name of the format that counts time in images and does not hold when they are shown
DEFAULT, ATTACHED_PICTURE, TIMED_THUMBNAILS = 0x1, 0x400, 0x800  # FFmpeg's bits of what a track is for
SHORT = 0.5  # a track that lasts a smaller share of the longest one is a preview
RATES = (0.01, 100_000.0)  # plausible frame rates, 1/s
USUAL_RATE = 25.0  # frame rate of a file without times, 1/s
MAX_HELD = 16  # decoded images that are held in memory to spread them over time
MATRIX_BYTES = 36  # of FFmpeg's display matrix, 3x3 integers of 32 bits
NEAR = 0.25  # time steps that differ from the median by less than this share are the usual step
SAME_RATE = 0.01  # a stated rate that differs from the measured one by less than this share is its exact value
Item = TypeVar("Item")


@dataclass(frozen=True)
class DecodedImage:
    """One image as the decoder gives it."""

    frame: av.VideoFrame
    seconds: float | None  # time in the file; None if it has no times
    damaged: bool  # bytes of it, or of an image that it was predicted from, are missing or wrong
    interlaced: bool  # whether the file says that its even and odd rows were taken at different times
    orientation: int  # of the stored pixels, as in EXIF: 1 as they are shown, 2 to 8 mirrored or turned


@dataclass
class Timeline:
    """Times that only increase, and counts of where those of the file do not."""

    step: float  # usual time between two images, s
    restarts: int = 0  # how often time starts again, as where two recordings were joined
    misplaced: int = 0  # images whose time is before that of the image before, while the next one is in order again
    repeated: int = 0  # images with the time of the image before

    def along(self, images: Iterable[tuple[Item, float | None]]) -> Iterator[tuple[Item, float]]:
        """The images, in their order, and their times, s: of the file, None where it has none, and on this line.

        Images of one time are spread up to the next time. A misplaced image keeps its time; all others are later than
        those before.
        """
        shift, last, before = 0.0, None, None
        for items, time, following in _of_one_time(images):
            now = (0.0 if last is None else last + self.step) if time is None else time + shift
            is_repeated = time is not None and time == before
            if is_repeated and last is not None:
                now = last + self.step
            elif time is not None and last is not None and now <= last:
                if following is not None and following + shift > last:
                    self.misplaced += len(items)
                    yield from ((item, now) for item in items)
                    continue
                self.restarts += before is None or time < before
                now = last + self.step
                shift = now - time
            self.repeated += len(items) - (not is_repeated)
            room = 0.0 if following is None else (following + shift - now) / len(items)
            spacing = min(room, self.step) if room > 0 else self.step
            for place, item in enumerate(items):
                last = now + place * spacing
                yield item, last
            before = time


def _of_one_time(
    images: Iterable[tuple[Item, float | None]],
) -> Iterator[tuple[list[Item], float | None, float | None]]:
    """Images in a row with the same time, at most `MAX_HELD` together; that time, and the one after it."""
    items, time = list[Item](), None
    for image, seconds in images:
        if items and (time is None or seconds != time or len(items) == MAX_HELD):
            yield items, time, seconds
            items = []
        items.append(image)
        time = seconds
    if items:
        yield items, time, None


def usual_rate(times: Sequence[float], stated: Sequence[float]) -> float:
    """Frame rate of a video, 1/s: that of most of its time steps. Pauses do not change it, nor do times that repeat.

    Args:
        times: of the images in the order of the file, s; they may start again.
        stated: rates that the file states, the best one first; they may be averages over pauses, or a clock.
    """
    usable = [rate for rate in stated if RATES[0] <= rate <= RATES[1]]
    runs = [(time, len(list(run))) for time, run in groupby(times)]
    steps = np.repeat(
        [(after - time) / count for (time, count), (after, _) in pairwise(runs)], [count for _, count in runs[:-1]]
    )
    steps = steps[steps > 1 / RATES[1]]
    if not len(steps):
        return usable[0] if usable else USUAL_RATE
    middle = float(np.median(steps))
    rate = 1 / float(steps[np.abs(steps - middle) < NEAR * middle].mean())
    exact = [each for each in usable if abs(each / rate - 1) < SAME_RATE]
    return exact[0] if exact else max(rate, RATES[0])


def choose_track(container: InputContainer) -> VideoStream | None:
    """The track of the video itself: not a cover, a single image or a preview. None if none can be decoded.

    Of several tracks, the one with the most pixels is taken, then the one that the file prefers, then the first.
    """
    tracks = [track for track in container.streams.video if track.codec_context is not None]
    longest = max((in_seconds(track, track.duration) for track in tracks), default=0.0)

    def rank(track: VideoStream) -> tuple[bool, bool, bool, int, bool]:
        is_short = bool(track.duration) and in_seconds(track, track.duration) < SHORT * longest
        size = (track.codec_context.width or 0) * (track.codec_context.height or 0)
        return not is_cover(track), track.frames != 1, not is_short, size, bool(int(track.disposition) & DEFAULT)

    return max(tracks, key=rank, default=None)


def in_seconds(track: VideoStream, ticks: int | None) -> float:
    """A time of a track, s; 0 without one."""
    return float((ticks or 0) * (track.time_base or 0))


def is_cover(track: VideoStream) -> bool:
    """Whether a track is a picture that belongs to the file, such as a cover."""
    return bool(int(track.disposition) & (ATTACHED_PICTURE | TIMED_THUMBNAILS))


def packet_times(container: InputContainer, track: VideoStream) -> tuple[list[float | None], int]:
    """The time of every image that is shown, in their order, s or None; and at which byte the last one lies.

    A file has its images in the order of decoding. Where the times of decoding start again, another part begins; within
    a part, the images are shown in the order of their times. Nothing is decoded.
    """
    parts: list[list[int | None]] = [[]]
    last, end = None, 0
    try:
        for packet in _packets(container, track):
            end = max(end, packet.pos or 0)
            if not packet.size or packet.is_discard:
                continue
            if packet.dts is not None:
                if last is not None and packet.dts < last:
                    parts.append([])
                last = packet.dts
            parts[-1].append(packet.pts if packet.pts is not None else packet.dts)
    except FFmpegError:  # the decoder meets it, too, and says what is missing
        pass
    ordered = [ticks for part in parts for ticks in sorted(part, key=lambda each: (each is None, each or 0))]
    return [None if ticks is None else in_seconds(track, ticks) for ticks in ordered], end


def _packets(container: InputContainer, track: VideoStream) -> Iterator[av.Packet]:
    """The packets of a track.

    In a fragmented MP4 whose times start again, FFmpeg marks images as not to be shown, though no edit list says so.
    """
    is_fragmented, shown = "mp4" in container.format.name and not track.frames, False
    for packet in container.demux(track):
        if is_fragmented and shown and packet.is_discard:
            whole = av.Packet(bytes(packet))
            whole.pts, whole.dts, whole.time_base = packet.pts, packet.dts, packet.time_base
            yield whole
            continue
        shown |= bool(packet.size) and not packet.is_discard
        yield packet


def decode(
    container: InputContainer, track: VideoStream, lost: list, *, one_thread: bool = False, weave: bool = False
) -> Iterator[DecodedImage]:
    """The images in the order in which they are shown; FFmpegError if the file cannot be read on.

    Args:
        lost: gets the place, in ticks, of each image that is in the file and cannot be decoded.
        one_thread: slower; with threads, FFmpeg does not report all damage, and not always the same.
        weave: keep the rows of interlaced images as they are.
    """
    if not track.codec_context.is_open:
        track.thread_type = "NONE" if one_thread else "AUTO"
    images = _with_damage(container, track, lost)
    return images if weave else _deinterlaced(images)


def _with_damage(container: InputContainer, track: VideoStream, lost: list) -> Iterator[DecodedImage]:
    """The images as stored.

    AVI holds the times at which images are decoded, not those at which they are shown. The decoder puts the images in
    order, and the n-th one gets the n-th time.

    An image that is damaged damages those that are predicted from it, which the decoder does not report: all up to the
    next key frame.
    """
    is_avi, decode_times = container.format.name == AVI, deque[int]()
    incomplete, spoiled = set[int | None](), False
    first, second, third = tee(_packets(container, track), 3)
    for packet, *following in zip_longest(first, islice(second, 1, None), islice(third, 2, None)):
        if is_avi and packet.dts is not None:
            decode_times.append(packet.dts)
        # Where the next part of a joined file begins, FFmpeg takes the end of the last part for a loss.
        later = [each.dts for each in following if each is not None and each.dts is not None]
        is_joint = packet.dts is not None and min(later, default=packet.dts) < packet.dts
        if packet.is_corrupt and not is_joint:
            incomplete.add(packet.pts)
        try:
            frames = track.decode(packet)
        except FFmpegError:
            lost.append(packet.dts)
            spoiled = True
            if is_avi and packet.dts is not None:
                decode_times.pop()
            continue
        for frame in frames:
            ticks = frame.pts if not is_avi else decode_times.popleft() if decode_times else None
            own = frame.is_corrupt or (frame.pts is not None and frame.pts in incomplete)
            incomplete.discard(frame.pts)
            spoiled = own or (spoiled and not frame.key_frame)
            seconds = None if ticks is None else in_seconds(track, ticks)
            yield DecodedImage(frame, seconds, spoiled, frame.interlaced_frame, _orientation(frame))


def _orientation(frame: av.VideoFrame) -> int:
    """That of the display matrix, in EXIF's numbers. It maps a stored pixel (x, y) to (a x + c y, b x + d y)."""
    every = cast(SideDataContainer, frame.side_data)  # PyAV's stub calls it a dictionary of something else
    stored = next((bytes(each) for each in every if each.type.name == "DISPLAYMATRIX"), b"")
    if len(stored) != MATRIX_BYTES:
        return 1
    a, b, _, c, d, *_ = np.frombuffer(stored, np.int32).astype(float)
    if abs(a * d) >= abs(b * c):
        return {(False, False): 1, (True, False): 2, (True, True): 3, (False, True): 4}[a < 0, d < 0]
    return {(False, False): 5, (True, False): 6, (True, True): 7, (False, True): 8}[c < 0, b < 0]


def _deinterlaced(images: Iterator[DecodedImage]) -> Iterator[DecodedImage]:
    """From the first interlaced image on, each such image gets the rows of one field, and those between made anew."""
    rows = None
    for image in images:
        if rows is None and not image.interlaced:
            yield image
            continue
        if rows is None or rows.kind != _kind(image.frame):
            yield from rows.after(None) if rows else ()
            rows = _MissingRows(image.frame)
        yield from rows.after(image)
    yield from rows.after(None) if rows else ()


def _kind(frame: av.VideoFrame) -> tuple[int, int, str]:
    return frame.width, frame.height, frame.format.name


class _MissingRows:
    """FFmpeg's bwdif: one image out for each one in, a little later. Images that are not interlaced stay."""

    def __init__(self, frame: av.VideoFrame) -> None:
        self.kind = _kind(frame)
        self._waiting: deque[DecodedImage] = deque()
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 25)
        )
        rows, sink = self._graph.add("bwdif", "mode=send_frame:deint=interlaced"), self._graph.add("buffersink")
        source.link_to(rows)
        rows.link_to(sink)
        self._graph.configure()

    def after(self, image: DecodedImage | None) -> Iterator[DecodedImage]:
        """The images that are complete after one more; the rest after None."""
        if image is not None:
            self._waiting.append(image)
        self._graph.push(None if image is None else image.frame)
        while self._waiting:
            try:
                frame = self._graph.pull()
            except (BlockingIOError, EOFError):
                return
            yield replace(self._waiting.popleft(), frame=frame)
