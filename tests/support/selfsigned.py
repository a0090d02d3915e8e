"""Certificates that a test makes for itself."""

import datetime
import ipaddress
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


class Issuer(NamedTuple):
    """Name and key that sign a certificate."""

    name: x509.Name
    key: ec.EllipticCurvePrivateKey


def self_made(folder: Path, host: str = "127.0.0.1", days: tuple[float, float] = (-1.0, 1.0)) -> tuple[Path, Path]:
    """A certificate for a host, valid between two days from now, and its key, as PEM files."""
    return _made(folder / "made", host, days)[0]


def without_intermediate(folder: Path) -> tuple[Path, tuple[Path, Path]]:
    """Root certificate, and a certificate with its key that one between has signed, which is in no file."""
    (root, _), issuer = _made(folder / "root", "root.example")
    _, between = _made(folder / "between", "between.example", issuer=issuer)
    return root, _made(folder / "leaf", "127.0.0.1", issuer=between)[0]


def _made(
    at: Path, host: str, days: tuple[float, float] = (-1.0, 1.0), issuer: Issuer | None = None
) -> tuple[tuple[Path, Path], Issuer]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"servotwin test {at.parent.name} {at.name}"[:64])])
    own = Issuer(name, key)
    by = issuer or own
    since, until = (datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=each) for each in days)
    builder = x509.CertificateBuilder(by.name, name, key.public_key(), x509.random_serial_number(), since, until)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    try:
        named: x509.GeneralName = x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        named = x509.DNSName(host)
    certificate = builder.add_extension(x509.SubjectAlternativeName([named]), False).sign(by.key, hashes.SHA256())
    paths = at.with_suffix(".crt"), at.with_suffix(".key")
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    plain = serialization.NoEncryption()
    paths[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain))
    paths[1].chmod(0o644)  # mosquitto may read it as another user
    return paths, own
