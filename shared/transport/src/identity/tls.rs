//! TLS 1.3 for both sides: one cipher provider, one signature scheme, and a verifier that checks the server's
//! signature and its pinned public key instead of a chain of authorities.
//!
//! Sessions are never resumed: a handshake costs one round trip, and tickets would make two runs differ.

use std::sync::{Arc, Mutex};

use quinn_proto::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::client::Resumption;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::CryptoProvider;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::{NoServerSessionStorage, ParsedCertificate};
use rustls::{CertificateError, DigitallySignedStruct, PeerIncompatible, SignatureScheme};

use crate::identity::{ExpectedIdentity, Fingerprint, IdentityError, ServerIdentity};

/// The protocol inside TLS, so that nothing else on the port is mistaken for it. The number rises with the framing of the
/// control stream, which two peers must share before they can say which versions they speak.
const ALPN: &[u8] = b"shadecast/2";
/// The name in every server's certificate. Identity is the key, not the name.
pub const SERVER_NAME: &str = "shadecast";

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

fn tls_error(error: impl std::fmt::Display) -> IdentityError {
    IdentityError::Generate(error.to_string())
}

pub(crate) fn server_config(identity: &ServerIdentity) -> Result<Arc<QuicServerConfig>, IdentityError> {
    let mut config = rustls::ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(tls_error)?
        .with_no_client_auth()
        .with_single_cert(vec![identity.certificate()], identity.private_key())
        .map_err(tls_error)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    config.max_early_data_size = 0;
    Ok(Arc::new(QuicServerConfig::try_from(config).map_err(tls_error)?))
}

pub(crate) fn client_config(verifier: Arc<PinVerifier>) -> Result<Arc<QuicClientConfig>, IdentityError> {
    let mut config = rustls::ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(tls_error)?
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_no_client_auth();
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.resumption = Resumption::disabled();
    Ok(Arc::new(QuicClientConfig::try_from(config).map_err(tls_error)?))
}

/// The cryptography of a client that believes whoever answers, for what speaks QUIC to a server by itself.
///
/// # Errors
/// The provider lacks what QUIC needs.
pub fn believing_client_crypto() -> Result<Arc<QuicClientConfig>, IdentityError> {
    client_config(PinVerifier::new(ExpectedIdentity::TrustOnFirstUse))
}

/// What a verifier found out about the server of its connection.
#[derive(Clone, Debug, Default)]
pub(crate) struct Verdict {
    /// The server's key, once its certificate was accepted.
    pub(crate) fingerprint: Option<Fingerprint>,
    /// Why its certificate was refused, in words for the user.
    pub(crate) refusal: Option<String>,
}

/// Accepts the server with the expected public key, of which it must prove possession. One for each connection.
#[derive(Debug)]
pub(crate) struct PinVerifier {
    expected: ExpectedIdentity,
    provider: Arc<CryptoProvider>,
    verdict: Mutex<Verdict>,
}

impl PinVerifier {
    pub(crate) fn new(expected: ExpectedIdentity) -> Arc<Self> {
        Arc::new(Self { expected, provider: provider(), verdict: Mutex::default() })
    }

    pub(crate) fn verdict(&self) -> Verdict {
        self.verdict.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }

    fn note(&self, verdict: Verdict) {
        *self.verdict.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = verdict;
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
        let certificate = ParsedCertificate::try_from(end_entity)?;
        let found = Fingerprint::of_public_key(&certificate.subject_public_key_info());
        if let ExpectedIdentity::Pinned { fingerprint, remedy } = &self.expected
            && found != *fingerprint
        {
            let refusal =
                format!("another identity than expected: {remedy} (expected {fingerprint}, found {found})");
            self.note(Verdict { fingerprint: None, refusal: Some(refusal) });
            return Err(CertificateError::ApplicationVerificationFailure.into());
        }
        self.note(Verdict { fingerprint: Some(found), refusal: None });
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Err(PeerIncompatible::Tls12NotOffered.into())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        rustls::crypto::verify_tls13_signature(message, cert, dss, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
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
        assert_eq!(verifier.verdict().fingerprint, Some(own.fingerprint()));
        assert!(verify(&verifier, &other.certificate()).is_err());
        let verdict = verifier.verdict();
        assert_eq!(verdict.fingerprint, None);
        let refusal = verdict.refusal.unwrap();
        let place =
            |text: &str| refusal.find(text).unwrap_or_else(|| panic!("\"{text}\" is not in: {refusal}"));
        let [expected, found] = [&own, &other].map(|server| place(&server.fingerprint().to_string()));
        assert!(place("delete line 3") < expected.min(found), "what to do comes first: {refusal}");
    }

    #[test]
    fn the_first_key_is_accepted_and_told() {
        let own = ServerIdentity::from_seed(1).unwrap();
        let verifier = PinVerifier::new(ExpectedIdentity::TrustOnFirstUse);
        verify(&verifier, &own.certificate()).unwrap();
        assert_eq!(verifier.verdict().fingerprint, Some(own.fingerprint()));
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
