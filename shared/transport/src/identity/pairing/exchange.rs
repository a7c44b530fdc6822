//! The exchange of keys, and the proofs over it.

use super::{Code, Word};
use crate::event::Binding;
use crate::identity::Fingerprint;
use ring::hmac;
use spake2::{Ed25519Group, Identity, Password, Spake2};

/// What a proof is about; the number rises with any change of the exchange.
const PURPOSE: &[u8] = b"shadecast pairing 1";
/// The byte before an element says whose it is: always the other side's here.
const CLIENT_SIDE: u8 = b'A';
const SERVER_SIDE: u8 = b'B';

/// Both ends of a connection, as one of them sees them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ends {
    /// The client's key.
    pub client: Fingerprint,
    /// The server's.
    pub server: Fingerprint,
    /// What only the ends of this connection know.
    pub binding: Binding,
}

/// The codes of the two sides differ, or there is somebody between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the code that was typed at the server is not the one that the headset shows")]
pub struct WrongCode;

/// What a server says once a code was typed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Its part of the exchange.
    pub element: Word,
    /// That it has the code.
    pub proof: Word,
}

/// Bytes that follow from random ones.
pub(super) struct Stream {
    key: hmac::Key,
    blocks: u64,
}

impl Stream {
    pub(super) fn new(random: &[u8; 64]) -> Self {
        Self { key: hmac::Key::new(hmac::HMAC_SHA256, random), blocks: 0 }
    }

    pub(super) fn fill(&mut self, bytes: &mut [u8]) {
        for part in bytes.chunks_mut(32) {
            let block = hmac::sign(&self.key, &self.blocks.to_le_bytes());
            part.copy_from_slice(&block.as_ref()[..part.len()]);
            self.blocks += 1;
        }
    }
}

impl rand_core::CryptoRng for Stream {}

impl rand_core::RngCore for Stream {
    fn next_u32(&mut self) -> u32 {
        self.next_u64() as u32
    }

    fn next_u64(&mut self) -> u64 {
        let mut bytes = [0; 8];
        self.fill(&mut bytes);
        u64::from_le_bytes(bytes)
    }

    fn fill_bytes(&mut self, bytes: &mut [u8]) {
        self.fill(bytes);
    }

    fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), rand_core::Error> {
        self.fill(bytes);
        Ok(())
    }
}

/// A client that has shown a code and waits for the server's answer.
pub(super) struct Offered {
    spake: Spake2<Ed25519Group>,
    ends: Ends,
    element: Word,
}

impl Offered {
    /// Begins with `code`; [`Self::element`] is for the server.
    pub(super) fn new(code: Code, ends: Ends, random: &mut Stream) -> Self {
        let (password, client, server) = parts(code, &ends);
        let (spake, message) = Spake2::start_a_with_rng(&password, &client, &server, random);
        Self { spake, ends, element: word_of(&message) }
    }

    pub(super) fn element(&self) -> Word {
        self.element
    }

    /// Checks the server's proof; gives the client's own.
    pub(super) fn finish(self, answer: &Answer) -> Result<Word, WrongCode> {
        let elements = [self.element, answer.element];
        let secret = self.spake.finish(&with_side(SERVER_SIDE, answer.element)).map_err(|_| WrongCode)?;
        let proofs = Proofs::new(&secret, self.ends, elements);
        proofs.check(SERVER_SIDE, &answer.proof)?;
        Ok(proofs.make(CLIENT_SIDE))
    }
}

/// A server that has answered and waits for the client's proof.
pub(super) struct Answered {
    proofs: Proofs,
}

impl Answered {
    /// Answers the client's element with the typed code.
    pub(super) fn new(
        code: Code,
        ends: Ends,
        element: Word,
        random: &mut Stream,
    ) -> Result<(Self, Answer), WrongCode> {
        let (password, client, server) = parts(code, &ends);
        let (spake, message) = Spake2::<Ed25519Group>::start_b_with_rng(&password, &client, &server, random);
        let own = word_of(&message);
        let secret = spake.finish(&with_side(CLIENT_SIDE, element)).map_err(|_| WrongCode)?;
        let proofs = Proofs::new(&secret, ends, [element, own]);
        let answer = Answer { element: own, proof: proofs.make(SERVER_SIDE) };
        Ok((Self { proofs }, answer))
    }

    pub(super) fn finish(self, proof: &Word) -> Result<(), WrongCode> {
        self.proofs.check(CLIENT_SIDE, proof)
    }
}

/// What both sides can prove that have the same code on the same connection.
struct Proofs {
    key: hmac::Key,
    about: Vec<u8>,
}

impl Proofs {
    fn new(secret: &[u8], ends: Ends, [client, server]: [Word; 2]) -> Self {
        let Ends { client: client_key, server: server_key, binding } = ends;
        let about = [PURPOSE, &binding.0, &client_key.0, &server_key.0, &client, &server].concat();
        Self { key: hmac::Key::new(hmac::HMAC_SHA256, secret), about }
    }

    fn of(&self, side: u8) -> Vec<u8> {
        [&self.about[..], &[side]].concat()
    }

    fn make(&self, side: u8) -> Word {
        let mut proof = [0; 32];
        proof.copy_from_slice(hmac::sign(&self.key, &self.of(side)).as_ref());
        proof
    }

    /// In constant time.
    fn check(&self, side: u8, proof: &Word) -> Result<(), WrongCode> {
        hmac::verify(&self.key, &self.of(side), proof).map_err(|_| WrongCode)
    }
}

fn parts(code: Code, ends: &Ends) -> (Password, Identity, Identity) {
    (Password::new(code.digits()), Identity::new(&ends.client.0), Identity::new(&ends.server.0))
}

/// A message of the crate is a byte that names the side, and an element.
fn word_of(message: &[u8]) -> Word {
    let mut word = [0; 32];
    word.copy_from_slice(&message[1..]);
    word
}

fn with_side(side: u8, element: Word) -> [u8; 33] {
    let mut message = [side; 33];
    message[1..].copy_from_slice(&element);
    message
}
