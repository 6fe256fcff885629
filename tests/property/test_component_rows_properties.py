"""Decoding one message gives what decoding it among others gives."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.encode import ITEMS_OFFSET
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.takes.files.component_rows import decode_row, decode_rows


@given(st.sampled_from([*ITEM_DTYPES]), st.integers(-2, 5), st.integers(-3, 3), st.data())
def test_one_message_has_the_same_content_alone_and_among_others(
    component: ComponentType, num_items: int, num_extra: int, data: st.DataObject
) -> None:
    size = max(0, ITEMS_OFFSET + num_items * ITEM_DTYPES[component].itemsize + num_extra)
    content = data.draw(st.binary(min_size=size, max_size=size))
    count = num_items.to_bytes(4, "big", signed=True)
    message = content[: ITEMS_OFFSET - 4] + count + content[ITEMS_OFFSET:]
    rows, row = decode_rows(component, [message]), decode_row(component, message)
    if rows.malformed or row is None:
        assert (rows.malformed, row) == (1, None)
        return
    [head], [items] = rows.heads.tolist(), rows.items.values()
    assert row[0] == head
    assert row[1].dtype == items.dtype
    assert row[1].shape == items.shape
    assert row[1].tobytes() == items.tobytes()
