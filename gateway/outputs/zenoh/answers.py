"""From a query that Zenoh delivers to its replies.

A query is admitted or refused in Zenoh's thread. The event loop takes one question in a turn, and a thread
sends the replies, because replying to a peer that has stopped reading blocks for 5 s, until Zenoh closes the
link. Dropping a query can block in the same way, and so can freeing one that has not been dropped: both tell
the peer that no further reply follows. So queries end in that thread only.

If a handler fails or does not reply, the peer cannot distinguish that from a gateway that is not running. So
every query gets a reply, which is an error if there is no answer, unless there are too many of them.
"""

import asyncio
import contextlib
import functools
import itertools
import logging
import time
from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import Final

import zenoh

from gateway.errors import QueryError, raise_unless_defect
from gateway.messages.decode import LCM_MESSAGES, TEXT, json_bytes
from gateway.messages.topics import zenoh_key
from gateway.outputs.contract import CONTROL_OPTION, STOP, Answer, KeyPath, QueryService
from gateway.outputs.query_admission import NO_REPLY, QueryAdmission, QueryDefects, QueryLimits, Refusal
from gateway.outputs.zenoh.open_questions import OpenQuestions, SharedQuestion
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.failures import log_fields
from gateway.runtime.losses import Losses
from gateway.runtime.safe_text import safe_text
from gateway.runtime.workers import WorkerThread

MAX_PENDING: Final = 4096
"""The maximum number of queries in progress. Further ones get the error busy."""

MAX_QUESTIONS: Final = 64
"""How many different questions are answered at a time; the others wait."""

MAX_KEY_CHARS: Final = 512
MAX_OPTIONS_CHARS: Final = 1024
MAX_PAYLOAD_BYTES: Final = 4096
"""The limits of a query. The payload and the attachment count together, and are ignored."""

MAX_PART_WILDCARDS: Final = 2
"""How many ``$*`` a selector may have: Zenoh's time to match grows with its power."""

LONG_ANSWER_BYTES: Final = 512 * 1024
"""A second thread sends longer answers (C3D files, takes), so that other answers need not wait.

It also sends messages of the history.
"""

_STOP_OPTION: Final = f"{CONTROL_OPTION}={STOP}"

_REST: Final = 3.0
"""How long the threads rest after they have made a payload, as a multiple of the time that this took.

So JSON for peers takes a quarter of a core at most.
"""

logger = logging.getLogger(__name__)


class ZenohAnswers:
    """Answers queries below PREFIX/SOURCE/ with ``service``.

    ``receive`` may be called in any thread; everything else runs in ``loop``. ``sender`` sends the replies;
    only C3D files and other long answers have a thread of their own, because two threads that block stop all
    of Zenoh meanwhile.
    """

    def __init__(
        self,
        settings: ZenohSettings,
        service: QueryService,
        loop: asyncio.AbstractEventLoop,
        sender: WorkerThread,
        losses: defaultdict[str, Losses],
    ) -> None:
        self._prefix = settings.prefix
        self._service = service
        self._loop = loop
        self.admission = QueryAdmission(
            QueryLimits.of("zenoh", "max_queries_per_key_per_s", settings, MAX_PENDING)
        )
        self._sender = sender
        self._long_sender = WorkerThread("zenoh-send-long")
        self._losses = losses
        self._questions = OpenQuestions(self._wake)
        self._tasks: set[asyncio.Task[None]] = set()
        self._numbers = itertools.count(1)  # of commands
        self._rest_until_s = 0.0
        self._defects = QueryDefects(logger)

    # In Zenoh's threads.

    def receive(self, source: str, query: zenoh.Query) -> None:
        """Take a query about ``source``, or refuse it."""
        if self._is_admitted(source, query):
            options = _options(query)
            number = next(self._numbers) if CONTROL_OPTION in options else 0
            question = SharedQuestion(source, str(query.key_expr), tuple(sorted(options.items())), number)
            if not self._questions.add(question, query):
                self._drop([query], source)

    def reply(self, source: str, query: zenoh.Query, answers: Mapping[str, Answer]) -> None:
        """Reply to a query about ``source`` with answers, by key, that are known already, or refuse it."""
        if self._is_admitted(source, query):
            self._send([query], source, answers)

    def _is_admitted(self, source: str, query: zenoh.Query) -> bool:
        selected = str(query.key_expr)
        is_stop = _STOP_OPTION in str(query.parameters)
        refusal = self.admission.admit(source, selected[:MAX_KEY_CHARS], is_stop=is_stop)
        if refusal is not None:
            self._refuse(source, query, refusal)
            return False
        try:
            _check(query, selected)
        except QueryError as error:
            self._send([query], source, error)
            return False
        return True

    def _refuse(self, source: str, query: zenoh.Query, refusal: Refusal) -> None:
        error = refusal.error

        def reply() -> None:
            with query:
                _reply_error(query, error)

        if refusal.cause == "queue":
            text = f"a query is refused as busy, because {MAX_PENDING} others are in progress; ask less often"
            self._losses[source].lost("query beyond the queue", text, frames=0)
        else:
            self._losses[source].lost("query beyond the rate", f"a query is refused: {error}", frames=0)
        if not self._sender.offer(reply if refusal.is_sent else query.drop):
            query.drop()  # this holds up the peers that ask, which is better than to store their queries

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(self._start_next)

    # In the event loop.

    def _start_next(self) -> None:
        """Start to answer one question. Frames that have arrived come before the next one."""
        question = self._questions.start_next(has_room=len(self._tasks) < MAX_QUESTIONS)
        if question is None:
            return
        with log_fields(source=question.source):
            task = asyncio.create_task(self._answer(question))
        self._tasks.add(task)
        task.add_done_callback(self._finish)
        self._loop.call_soon(self._start_next)

    def _finish(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if self._questions.resume():
            self._loop.call_soon(self._start_next)

    async def _answer(self, question: SharedQuestion) -> None:
        outcome: dict[str, Answer] | QueryError | None = None
        try:
            if self._service.serves(question.source):
                outcome = await self._answers(question)
        except QueryError as error:
            outcome = error
        except BaseException as defect:  # noqa: BLE001 - every query gets a reply
            raise_unless_defect(defect)
            outcome = self._defects.log(question.source, defect, f"query {safe_text(question.selector)}")
        finally:
            queries = self._questions.take_queries(question)
        if outcome is None:  # the source has been removed
            self._drop(queries, question.source)
        else:
            self._send(queries, question.source, outcome)

    async def _answers(self, question: SharedQuestion) -> dict[str, Answer]:
        """Return the answers by key. Raises QueryError if there is none."""
        source, selected, options = question.source, question.selected, dict(question.options)
        base = zenoh_key(self._prefix, source) + "/"
        if "*" not in selected and selected.startswith(base):
            path = tuple(selected.removeprefix(base).split("/"))
            return {selected: await self._service.answer(source, path, options)}
        paths = _matching(selected, base, tuple(self._service.keys(source)))
        if not paths:
            for command in self._service.commands():
                if selected.endswith(f"/{command}"):
                    raise QueryError(
                        f"{command} needs the name of one source, not a wildcard; accepted: {base}{command}"
                    )
            accepted = self._service.accepted_keys(source)
            raise QueryError(
                f"nothing of source {source!r} matches {selected}; accepted below {base}: {accepted}"
            )
        self.admission.count(len(paths) - 1)
        answers = await self._service.answer_all(source, paths, options)
        return {base + "/".join(path): answer for path, answer in answers.items()}

    async def close(self) -> None:
        """Drop the pending queries, and close the sender. Peers see at once that no reply follows."""
        pending = self._questions.close()

        def drop() -> None:
            for question, queries in pending:
                self._drop_now(queries, question.source)

        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._sender.close(drop)
        self._long_sender.close()

    # In any thread.

    def _send(
        self, queries: list[zenoh.Query], source: str, outcome: Mapping[str, Answer] | QueryError
    ) -> None:
        answers = () if isinstance(outcome, QueryError) else outcome.values()
        num_bytes = sum(answer.num_bytes for answer in answers)
        sender = self._long_sender if _is_long(answers) else self._sender
        for query in queries:
            reply = functools.partial(self._reply, query, source, outcome)
            if not sender.offer(reply, num_bytes // len(queries)):
                self._drop([query], source)
                if not self._questions.is_closed:
                    self._losses[source].lost(
                        "answer beyond the queue",
                        "answers to queries are dropped, because earlier ones wait to be sent; ask less "
                        "often, and check for peers that ask and do not read the answers",
                        frames=0,
                    )

    def _drop(self, queries: list[zenoh.Query], source: str) -> None:
        """Let the peers see that no reply follows."""
        drop = functools.partial(self._drop_now, queries, source)
        if self._sender.submit(drop).cancelled():  # it is closed
            drop()

    # In a thread that sends. Zenoh's calls may block.

    def _drop_now(self, queries: list[zenoh.Query], source: str) -> None:
        for query in queries:
            query.drop()
            self.admission.finished(source, NO_REPLY)

    def _reply(self, query: zenoh.Query, source: str, outcome: Mapping[str, Answer] | QueryError) -> None:
        result = "ok"
        try:
            with query:
                try:
                    if isinstance(outcome, QueryError):
                        raise outcome
                    self._reply_all(query, outcome)
                except QueryError as error:
                    result = error.code
                    _reply_error(query, error)
        except BaseException as problem:  # noqa: BLE001 - the thread continues
            raise_unless_defect(problem)
            result = "defect"
            self._defects.log(source, problem, f"query {safe_text(str(query.key_expr))}")
        finally:
            self.admission.finished(source, result)

    def _reply_all(self, query: zenoh.Query, answers: Mapping[str, Answer]) -> None:
        """Reply with each of the answers. Raises QueryError if there is none, or too many bytes."""
        num_bytes = sum(answer.num_bytes for answer in answers.values())
        self.admission.check_reply(num_bytes, is_long=_is_long(answers.values()))
        num_replies, error = 0, None
        for key, answer in answers.items():
            try:
                payload = self._payload(answer)
            except QueryError as problem:
                error = problem
                continue
            num_replies += 1
            attachment = json_bytes(answer.attachment) if answer.attachment else None
            try:
                query.reply(key, payload, encoding=answer.encoding, attachment=attachment)
            except zenoh.ZError as problem:
                logger.debug("zenoh: replying to %s: %s", query.selector, problem)
        if error is not None and num_replies == 0:
            raise error

    def _payload(self, answer: Answer) -> bytes:
        """Return the payload of an answer, and make it if necessary, with rests in between."""
        if isinstance(answer.content, bytes) or answer.content.is_made:
            return answer.payload
        time.sleep(max(0.0, self._rest_until_s - time.monotonic()))
        begun_s = time.thread_time()
        try:
            return answer.payload
        finally:
            self._rest_until_s = time.monotonic() + _REST * (time.thread_time() - begun_s)


def _is_of_history(answer: Answer) -> bool:
    return answer.encoding.startswith(LCM_MESSAGES)


def _is_long(answers: Collection[Answer]) -> bool:
    """Return whether other answers need not wait for these: they are long, or parts of something long."""
    num_bytes = sum(answer.num_bytes for answer in answers)
    return num_bytes > LONG_ANSWER_BYTES or any(map(_is_of_history, answers))


def _reply_error(query: zenoh.Query, error: QueryError) -> None:
    """Reply with an error. The schema of the encoding is the error's code."""
    try:
        query.reply_err(str(error), encoding=zenoh.Encoding(TEXT).with_schema(error.code))
    except zenoh.ZError as problem:
        logger.debug("zenoh: replying to %s: %s", query.selector, problem)


def _check(query: zenoh.Query, selected: str) -> None:
    """Raise QueryError if a query is too long, or its selector takes too long to match."""
    num_bytes = sum(len(each) for each in (query.payload, query.attachment) if each is not None)
    if num_bytes > MAX_PAYLOAD_BYTES:
        raise QueryError(
            f"a query has {num_bytes} bytes of payload and attachment; accepted: {MAX_PAYLOAD_BYTES}"
        )
    if len(selected) > MAX_KEY_CHARS:
        raise QueryError(f"a key has {len(selected)} characters; accepted: {MAX_KEY_CHARS}")
    if len(str(query.parameters)) > MAX_OPTIONS_CHARS:
        raise QueryError(f"the options have more than {MAX_OPTIONS_CHARS} characters")
    if selected.count("$*") > MAX_PART_WILDCARDS:
        raise QueryError(f"a selector has more than {MAX_PART_WILDCARDS} times $*; use * or **")


@functools.lru_cache(maxsize=256)
def _matching(selected: str, base: str, paths: tuple[KeyPath, ...]) -> list[KeyPath]:
    """Return the keys of a source that a selector with wildcards matches.

    A C3D file may have hundreds of MB, so it is selected only by its name, as in mocap/*/c3d.
    """
    expression, last = zenoh.KeyExpr(selected), selected.rpartition("/")[2]
    return [
        path
        for path in paths
        if (path != ("c3d",) or last == "c3d") and expression.intersects(zenoh.KeyExpr(base + "/".join(path)))
    ]


def _options(query: zenoh.Query) -> dict[str, str]:
    """Return the selector's options; names that start with _ are Zenoh's own."""
    options = {}
    for pair in filter(None, str(query.parameters).split(";")):
        name, _, value = pair.partition("=")
        if not name.startswith("_"):
            options[name] = value
    return options
