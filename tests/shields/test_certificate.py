import pytest

from shields import Certificate, CertificateError


@pytest.mark.parametrize(
    "content",
    [
        *("", "{}", "[]", "null", '"text"', '{"format": "other"}', "[" * 100_000, "\x00\xff"),
        *("\x80\x04cos\nsystem\n", '{"format": ' + "9" * 100_000 + "}"),
    ],
)
def test_files_of_another_kind_are_refused_in_one_sentence(content, tmp_path):
    path = tmp_path / "file.json"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(CertificateError) as caught:
        Certificate.load(path)
    assert "\n" not in str(caught.value)


def test_a_reader_never_sees_half_a_file(certificate, tmp_path, monkeypatch):
    path = tmp_path / "c.json"
    certificate.save(path)
    before = path.read_bytes()

    def fail(handle):
        assert path.read_bytes() == before  # the old file stands while the new one is written
        raise OSError("disk full")

    monkeypatch.setattr("shields.documents.os.fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        certificate.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
