from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import pairing
from protocol.errors import LocalWireError

codes = st.binary(min_size=pairing.CODE_BYTES, max_size=pairing.CODE_BYTES)
KEY = "1444bcb929e8de79cee011b2b4ac5142f93422acac4dc9f022bad10332af62e8"
CLIENT = "c839a0c514a140156a1eaca31d485439feb13fc65926b539acec9ea0ad7e2386"
NODE = "4201465170bba30500a5e7ebdb9bc7318ada3094c94e57426424a7b55616b4a4"
SEEN, OTHER, NONCE = "ab" * 32, "cd" * 32, "01" * 16


@given(codes)
def test_a_code_is_read_as_it_was_shown_however_it_is_typed(code: bytes) -> None:
    text = pairing.code_text(code)
    assert len(text) == 19
    for typed in (text, text.lower(), text.replace("-", ""), f" {text.replace('-', ' ')} "):
        assert pairing.parse_code(typed) == code


@pytest.mark.parametrize("text", ["", "ABCD", "ABCD-EFGH-IJKL-MNO1", "ABCD-EFGH-IJKL-MNOP-QRST", "é" * 16, "=" * 16])
def test_what_is_no_code_is_refused(text: str) -> None:
    with pytest.raises(LocalWireError, match="16 letters"):
        pairing.parse_code(text)


@given(codes, codes)
def test_a_proof_holds_for_one_code_one_certificate_one_nonce_and_one_end(code: bytes, other: bytes) -> None:
    key = pairing.key_of(code)
    proof = pairing.client_proof(key, SEEN, NONCE)
    assert proof == pairing.client_proof(key, SEEN, NONCE)
    assert proof != pairing.client_proof(key, OTHER, NONCE)
    assert proof != pairing.client_proof(key, SEEN, "02" * 16)
    assert proof != pairing.node_proof(key, SEEN, NONCE, "token", "view")
    assert pairing.node_proof(key, SEEN, NONCE, "token", "view") != pairing.node_proof(
        key, SEEN, NONCE, "token", "admin"
    )
    if code != other:
        assert proof != pairing.client_proof(pairing.key_of(other), SEEN, NONCE)


def test_proofs_are_those_of_the_protocol() -> None:
    key = pairing.key_of(bytes(range(10)))
    assert pairing.code_text(bytes(range(10))) == "AAAQ-EAYE-AUDA-OCAJ"
    assert key.hex() == KEY
    assert pairing.client_proof(key, SEEN, NONCE) == CLIENT
    assert pairing.node_proof(key, SEEN, NONCE, "token", "operate") == NODE


@pytest.mark.parametrize("field", [{"nonce": "ab"}, {"proof": "AB" * 32}, {"more": 1}])
def test_a_request_out_of_bounds_is_refused(field: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"nonce": NONCE, "proof": SEEN, **field}, pairing.PairRequest)
