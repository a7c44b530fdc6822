//! TLS 1.3 for both sides: one cipher provider, one signature scheme, and verifiers that check signatures and keys instead
//! of a chain of authorities. Both sides show a certificate; a client without one does not get in.
//!
//! Sessions are never resumed: a handshake costs one round trip, and tickets would make two runs differ.

use std::sync::{Arc, Mutex};

use quinn_proto::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::client::Resumption;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::CryptoProvider;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{NoServerSessionStorage, ParsedCertificate};
use rustls::{CertificateError, DigitallySignedStruct, DistinguishedName, PeerIncompatible, SignatureScheme};

use crate::identity::{ClientIdentity, ExpectedIdentity, Fingerprint, IdentityError, ServerIdentity};

/// The protocol inside TLS, so that nothing else on the port is mistaken for it. The number rises with the framing of the
/// control stream and with what the handshake demands, which two peers must share before they can say which versions they
/// speak.
const ALPN: &[u8] = b"shadecast/3";
/// Label of the bytes that both ends of a connection derive from its keys (RFC 8446, section 7.5): the same at both ends of
/// one connection, and at no other's.
const BINDING_LABEL: &[u8] = b"EXPORTER-shadecast-pairing";
/// The name in every server's certificate. Identity is the key, not the name.
pub const SERVER_NAME: &str = "shadecast";

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

fn tls_error(error: impl std::fmt::Display) -> IdentityError {
    IdentityError::Generate(error.to_string())
}

pub(crate) fn server_config(identity: &ServerIdentity) -> Result<Arc<QuicServerConfig>, IdentityError> {
    Ok(Arc::new(QuicServerConfig::try_from(server_tls(identity)?).map_err(tls_error)?))
}

fn server_tls(identity: &ServerIdentity) -> Result<rustls::ServerConfig, IdentityError> {
    let mut config = rustls::ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(tls_error)?
        .with_client_cert_verifier(Arc::new(AnyKeyVerifier { provider: provider() }))
        .with_single_cert(vec![identity.certificate()], identity.private_key())
        .map_err(tls_error)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    config.max_early_data_size = 0;
    Ok(config)
}

pub(crate) fn client_config(
    identity: &ClientIdentity,
    verifier: Arc<PinVerifier>,
) -> Result<Arc<QuicClientConfig>, IdentityError> {
    let mut config = rustls::ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(tls_error)?
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_client_auth_cert(vec![identity.certificate()], identity.private_key())
        .map_err(tls_error)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.resumption = Resumption::disabled();
    Ok(Arc::new(QuicClientConfig::try_from(config).map_err(tls_error)?))
}

/// The cryptography of a client that believes whoever answers and has a key of its own, for what speaks QUIC to a server by
/// itself.
///
/// # Errors
/// The provider lacks what QUIC needs.
pub fn believing_client_crypto() -> Result<Arc<QuicClientConfig>, IdentityError> {
    client_config(&ClientIdentity::generate()?, PinVerifier::new(ExpectedIdentity::TrustOnFirstUse))
}

/// The bytes of [`BINDING_LABEL`]; `None` before the handshake is over.
pub(crate) fn binding_of(session: &dyn quinn_proto::crypto::Session) -> Option<[u8; 32]> {
    let mut bytes = [0; 32];
    session.export_keying_material(&mut bytes, BINDING_LABEL, &[]).ok().map(|()| bytes)
}

/// The key that the peer has proved to have in the handshake.
pub(crate) fn fingerprint_of(session: &dyn quinn_proto::crypto::Session) -> Option<Fingerprint> {
    let chain = session.peer_identity()?.downcast::<Vec<CertificateDer<'static>>>().ok()?;
    fingerprint_in(chain.first()?).ok()
}

fn fingerprint_in(certificate: &CertificateDer<'_>) -> Result<Fingerprint, rustls::Error> {
    let certificate = ParsedCertificate::try_from(certificate)?;
    Ok(Fingerprint::of_public_key(&certificate.subject_public_key_info()))
}

/// Signatures that either side may prove its key by.
const SCHEMES: [SignatureScheme; 1] = [SignatureScheme::ED25519];

/// Whether a peer has signed with the key of its certificate.
fn proves_key(
    provider: &CryptoProvider,
    message: &[u8],
    certificate: &CertificateDer<'_>,
    signed: &DigitallySignedStruct,
) -> Result<HandshakeSignatureValid, rustls::Error> {
    let algorithms = &provider.signature_verification_algorithms;
    rustls::crypto::verify_tls13_signature(message, certificate, signed, algorithms)
}

fn no_tls12() -> Result<HandshakeSignatureValid, rustls::Error> {
    Err(PeerIncompatible::Tls12NotOffered.into())
}

/// A client may have any key, of which it must prove possession: whether it is served is decided by its fingerprint, above.
#[derive(Debug)]
struct AnyKeyVerifier {
    provider: Arc<CryptoProvider>,
}

impl ClientCertVerifier for AnyKeyVerifier {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, rustls::Error> {
        fingerprint_in(end_entity).map(|_| ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        no_tls12()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        proves_key(&self.provider, message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        SCHEMES.to_vec()
    }
}

/// Accepts the server with the expected public key, of which it must prove possession. One for each connection.
#[derive(Debug)]
pub(crate) struct PinVerifier {
    expected: ExpectedIdentity,
    provider: Arc<CryptoProvider>,
    /// Why the server's certificate was refused, in words for the user.
    refusal: Mutex<Option<String>>,
}

impl PinVerifier {
    pub(crate) fn new(expected: ExpectedIdentity) -> Arc<Self> {
        Arc::new(Self { expected, provider: provider(), refusal: Mutex::default() })
    }

    pub(crate) fn refusal(&self) -> Option<String> {
        self.refusal.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }
}

impl ServerCertVerifier for PinVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let found = fingerprint_in(end_entity)?;
        if let ExpectedIdentity::Pinned { fingerprint, remedy } = &self.expected
            && found != *fingerprint
        {
            let refusal =
                format!("another identity than expected: {remedy} (expected {fingerprint}, found {found})");
            *self.refusal.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(refusal);
            return Err(CertificateError::ApplicationVerificationFailure.into());
        }
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        no_tls12()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        proves_key(&self.provider, message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        SCHEMES.to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verify(verifier: &PinVerifier, certificate: &CertificateDer<'_>) -> Result<(), rustls::Error> {
        let name = ServerName::try_from(SERVER_NAME).unwrap();
        verifier.verify_server_cert(certificate, &[], &name, &[], UnixTime::now()).map(|_| ())
    }

    fn pinned(seed: u64) -> Arc<PinVerifier> {
        let fingerprint = ServerIdentity::from_seed(seed).unwrap().fingerprint();
        PinVerifier::new(ExpectedIdentity::Pinned { fingerprint, remedy: "delete line 3".into() })
    }

    #[test]
    fn the_pinned_key_is_accepted_and_another_refused_with_the_remedy() {
        let (own, other) = (ServerIdentity::from_seed(1).unwrap(), ServerIdentity::from_seed(2).unwrap());
        let verifier = pinned(1);
        verify(&verifier, &own.certificate()).unwrap();
        assert_eq!(verifier.refusal(), None);
        assert!(verify(&verifier, &other.certificate()).is_err());
        let refusal = verifier.refusal().unwrap();
        let place =
            |text: &str| refusal.find(text).unwrap_or_else(|| panic!("\"{text}\" is not in: {refusal}"));
        let [expected, found] = [&own, &other].map(|server| place(&server.fingerprint().to_string()));
        assert!(place("delete line 3") < expected.min(found), "what to do comes first: {refusal}");
    }

    #[test]
    fn the_first_key_is_accepted() {
        let own = ServerIdentity::from_seed(1).unwrap();
        let verifier = PinVerifier::new(ExpectedIdentity::TrustOnFirstUse);
        verify(&verifier, &own.certificate()).unwrap();
        assert_eq!(verifier.refusal(), None);
    }

    #[test]
    fn any_client_key_is_accepted_and_what_is_no_certificate_is_not() {
        let verifier = AnyKeyVerifier { provider: provider() };
        let verify = |certificate: &[u8]| {
            let certificate = CertificateDer::from(certificate);
            verifier.verify_client_cert(&certificate, &[], UnixTime::now()).map(|_| ())
        };
        for seed in [1, 2] {
            verify(&ClientIdentity::from_seed(seed).unwrap().certificate()).unwrap();
        }
        let whole = ClientIdentity::from_seed(1).unwrap().certificate();
        for bytes in [&[][..], &[0x30, 0x80], &whole[..whole.len() / 2]] {
            assert!(verify(bytes).is_err());
        }
        assert!(verifier.client_auth_mandatory() && verifier.offer_client_auth());
    }

    #[test]
    fn a_client_without_a_key_is_not_let_in() {
        let pin = PinVerifier::new(ExpectedIdentity::TrustOnFirstUse);
        let builder = rustls::ClientConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(pin);
        let own = ClientIdentity::from_seed(1).unwrap();
        let keyed = builder.clone().with_client_auth_cert(vec![own.certificate()], own.private_key());
        let refusal = |mut config: rustls::ClientConfig| {
            config.alpn_protocols = vec![ALPN.to_vec()];
            let name = ServerName::try_from(SERVER_NAME).unwrap();
            let mut client = rustls::ClientConnection::new(Arc::new(config), name).unwrap();
            let server = Arc::new(server_tls(&ServerIdentity::from_seed(2).unwrap()).unwrap());
            let mut server = rustls::ServerConnection::new(server).unwrap();
            (0..4).find_map(|_| {
                let mut bytes = Vec::new();
                client.write_tls(&mut bytes).unwrap();
                server.read_tls(&mut &bytes[..]).unwrap();
                let taken = server.process_new_packets().err();
                bytes.clear();
                server.write_tls(&mut bytes).unwrap();
                client.read_tls(&mut &bytes[..]).unwrap();
                let _ = client.process_new_packets();
                taken
            })
        };
        assert_eq!(refusal(builder.with_no_client_auth()), Some(rustls::Error::NoCertificatesPresented));
        assert_eq!(refusal(keyed.unwrap()), None);
    }

    #[test]
    fn what_is_no_certificate_is_refused() {
        let verifier = PinVerifier::new(ExpectedIdentity::TrustOnFirstUse);
        let whole = ServerIdentity::from_seed(1).unwrap().certificate();
        for bytes in [&[][..], &[0x30, 0x80], &whole[..whole.len() / 2]] {
            assert!(verify(&verifier, &CertificateDer::from(bytes)).is_err());
        }
    }
}
