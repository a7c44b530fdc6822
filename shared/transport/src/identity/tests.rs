use super::key::KEY_FILE;
use super::known::KNOWN_SERVERS_FILE;
use super::*;
use crate::rng;
use std::net::SocketAddr;

#[cfg(unix)]
fn set_mode(path: &Path, mode: u32) {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

#[cfg(windows)]
fn set_mode(_: &Path, _: u32) {}

fn is_private(path: &Path) -> bool {
    owner::open_to_others(&fs::metadata(path).unwrap()).is_none()
}

#[test]
fn an_identity_survives_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let directory = dir.path().join("new/shadecast");
    let first = ServerIdentity::load_or_create(&directory).unwrap();
    let second = ServerIdentity::load_or_create(&directory).unwrap();
    assert_eq!(first.fingerprint(), second.fingerprint());
    assert_eq!(first.certificate(), second.certificate());
    assert_eq!(fs::read_dir(&directory).unwrap().count(), 1, "only the key file is left");
}

#[cfg(unix)]
#[test]
fn a_client_has_a_key_of_its_own_beside_a_server() {
    let dir = tempfile::tempdir().unwrap();
    let server = ServerIdentity::load_or_create(dir.path()).unwrap();
    let client = ClientIdentity::load_or_create(dir.path()).unwrap();
    assert_ne!(client.fingerprint(), server.fingerprint());
    assert_eq!(ClientIdentity::load_or_create(dir.path()).unwrap().fingerprint(), client.fingerprint());
    assert!(is_private(&dir.path().join("client-key.pem")));
    let seeded = [ServerIdentity::from_seed(7).unwrap().fingerprint(), client_of_seed(7)];
    assert_ne!(seeded[0], seeded[1], "a seed is no way from the one to the other");
}

#[cfg(unix)]
fn client_of_seed(seed: u64) -> Fingerprint {
    ClientIdentity::from_seed(seed).unwrap().fingerprint()
}

#[test]
fn a_pipe_in_the_place_of_a_file_is_refused_and_not_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    for name in [KEY_FILE, KNOWN_SERVERS_FILE] {
        let made =
            std::process::Command::new("mkfifo").arg("-m").arg("600").arg(dir.path().join(name)).status();
        assert!(made.unwrap().success());
    }
    let key = ServerIdentity::load_or_create(dir.path()).unwrap_err();
    let known = KnownServers::load(dir.path()).unwrap_err();
    for error in [key, known] {
        assert!(matches!(error, IdentityError::NotAFile { .. }), "{error}");
        assert!(error.to_string().contains("this is not a file"), "{error}");
    }
}

#[cfg(unix)]
#[test]
fn the_private_key_belongs_to_its_owner_alone() {
    let dir = tempfile::tempdir().unwrap();
    ServerIdentity::load_or_create(dir.path()).unwrap();
    let path = dir.path().join(KEY_FILE);
    assert!(is_private(&path));
    set_mode(&path, 0o640);
    let message = ServerIdentity::load_or_create(dir.path()).unwrap_err().to_string();
    assert!(message.contains("mode 0640") && message.contains("chmod 600"), "{message}");
}

#[test]
fn two_identities_differ_and_a_seed_repeats() {
    let of = |seed| ServerIdentity::from_seed(seed).unwrap();
    assert_ne!(of(1).fingerprint(), of(2).fingerprint());
    assert_eq!(of(1).certificate(), of(1).certificate());
    let fresh = || ServerIdentity::generate().unwrap().fingerprint();
    assert_ne!(fresh(), fresh());
}

#[test]
fn certificates_of_all_keys_have_one_length() {
    let lengths: Vec<usize> =
        (0..300).map(|seed| ServerIdentity::from_seed(seed).unwrap().certificate().len()).collect();
    assert!(lengths.iter().all(|&length| length == lengths[0]), "{lengths:?}");
}

#[test]
fn a_damaged_key_file_is_named_with_the_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(KEY_FILE);
    for content in
        [&b""[..], b"hello", b"\xff\xfe", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n"]
    {
        fs::write(&path, content).unwrap();
        set_mode(&path, 0o600);
        let message = ServerIdentity::load_or_create(dir.path()).unwrap_err().to_string();
        assert!(message.contains(KEY_FILE) && message.contains("delete the file"), "{message}");
    }
}

fn at(address: &str) -> SocketAddr {
    address.parse().unwrap()
}

fn fingerprint(seed: u64) -> Fingerprint {
    ServerIdentity::from_seed(seed).unwrap().fingerprint()
}

#[track_caller]
fn pinned(known: &KnownServers, name: &str, address: &str) -> (Fingerprint, String) {
    match known.expected(name, at(address)) {
        ExpectedIdentity::Pinned { fingerprint, remedy } => (fingerprint, remedy),
        ExpectedIdentity::TrustOnFirstUse => panic!("{name} at {address} is not pinned"),
    }
}

#[test]
fn a_known_server_is_expected_the_next_time() {
    let dir = tempfile::tempdir().unwrap();
    let directory = dir.path().join("client");
    let mut known = KnownServers::load(&directory).unwrap();
    let (name, address) = ("pc.local:47800", "192.168.1.5:47800");
    assert_eq!(known.expected(name, at(address)), ExpectedIdentity::TrustOnFirstUse);
    assert_eq!(known.remember(name, at(address), fingerprint(3)).unwrap(), Meeting::First);
    assert_eq!(known.remember(name, at(address), fingerprint(3)).unwrap(), Meeting::Again);

    let known = KnownServers::load(&directory).unwrap();
    let (expected, remedy) = pinned(&known, name, address);
    assert_eq!(expected, fingerprint(3));
    for word in [name, address, KNOWN_SERVERS_FILE] {
        assert!(remedy.contains(word), "{remedy}");
    }
    assert_eq!(known.expected("other:1", at("10.0.0.1:1")), ExpectedIdentity::TrustOnFirstUse);
    assert!(is_private(&known.path));
}

#[test]
fn a_server_is_its_key_and_not_the_string_that_was_typed() {
    let dir = tempfile::tempdir().unwrap();
    let mut known = KnownServers::load(dir.path()).unwrap();
    let loopback = "127.0.0.1:7400";
    known.remember("localhost:7400", at(loopback), fingerprint(3)).unwrap();
    assert_eq!(pinned(&known, loopback, loopback).0, fingerprint(3), "its address is known too");
    assert_eq!(pinned(&known, "pc.local:7400", loopback).0, fingerprint(3), "whatever leads there");
    let elsewhere = at("[::1]:7400");
    assert_eq!(known.expected("[::1]:7400", elsewhere), ExpectedIdentity::TrustOnFirstUse);
    let meeting = known.remember("[::1]:7400", elsewhere, fingerprint(3)).unwrap();
    assert_eq!(meeting, Meeting::KnownAs(loopback.to_owned()), "the key is known under another name");
    assert_eq!(known.remember("[::1]:7400", elsewhere, fingerprint(3)).unwrap(), Meeting::Again);
}

#[test]
fn a_reassigned_address_does_not_lock_out_its_old_server() {
    let dir = tempfile::tempdir().unwrap();
    let mut known = KnownServers::load(dir.path()).unwrap();
    let address = "192.168.1.5:7400";
    known.remember("old.local:7400", at(address), fingerprint(1)).unwrap();
    known.remember("new.local:7400", at("192.168.1.6:7400"), fingerprint(2)).unwrap();
    let (expected, remedy) = pinned(&known, "new.local:7400", address);
    assert_eq!(expected, fingerprint(2), "the name counts");
    assert!(!remedy.contains(address), "the address's line is not to blame: {remedy}");
    assert_eq!(known.remember("new.local:7400", at(address), fingerprint(2)).unwrap(), Meeting::Again);
    assert_eq!(pinned(&known, address, address).0, fingerprint(2));
    assert_eq!(pinned(&known, "old.local:7400", address).0, fingerprint(1), "its name is still its own");
}

#[test]
fn a_list_of_an_earlier_version_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let text = format!("# Servers this client has met.\n\"pc.local:7400\" = \"{}\"\n", fingerprint(3));
    fs::write(dir.path().join(KNOWN_SERVERS_FILE), text).unwrap();
    let mut known = KnownServers::load(dir.path()).unwrap();
    let address = "192.168.1.5:7400";
    assert_eq!(pinned(&known, "pc.local:7400", address).0, fingerprint(3));
    assert_eq!(known.remember("pc.local:7400", at(address), fingerprint(3)).unwrap(), Meeting::Again);
    assert_eq!(pinned(&known, address, address).0, fingerprint(3));
}

#[test]
fn the_last_server_is_remembered_with_its_address() {
    let dir = tempfile::tempdir().unwrap();
    let load = || KnownServers::load(dir.path()).unwrap();
    let mut known = load();
    assert_eq!(known.last(), None);
    known.remember("desk", at("192.168.1.5:7400"), fingerprint(1)).unwrap();
    known.remember("attic", at("192.168.1.6:7400"), fingerprint(2)).unwrap();
    known.remember("desk", at("[fe80::1%3]:7400"), fingerprint(1)).unwrap();
    let (name, address) = ("desk".to_owned(), at("[fe80::1%3]:7400"));
    let last = LastServer { name, address, fingerprint: fingerprint(1) };
    assert_eq!(load().last(), Some(&last));
    let text = fs::read_to_string(&known.path).unwrap();
    assert_eq!(text.matches("last_address").count(), 1, "{text}");
    known.remember("attic", at("192.168.1.6:7400"), fingerprint(2)).unwrap();
    assert_eq!(load().last().map(|last| last.name.clone()), Some("attic".into()), "nothing else is new");
    let mut others: Vec<&str> = text.lines().collect();
    others.retain(|line| !line.starts_with("\"desk\""));
    fs::write(&known.path, others.join("\n")).unwrap();
    assert_eq!(load().last(), None, "its line was deleted");
}

#[test]
fn who_cannot_reach_the_list_is_told_what_else_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let mut known = KnownServers::load(dir.path()).unwrap().with_remedy("clear the data");
    known.remember("desk", at("192.168.1.5:7400"), fingerprint(1)).unwrap();
    let (_, remedy) = pinned(&known, "desk", "192.168.1.5:7400");
    assert_eq!(remedy, "if it was set up anew, clear the data");
}

#[test]
fn any_address_can_be_remembered() {
    let dir = tempfile::tempdir().unwrap();
    let odd = "a\"b\\c\td\u{1}é = ]:1";
    let address = at("[fe80::1%3]:7400");
    KnownServers::load(dir.path()).unwrap().remember(odd, address, Fingerprint([7; 32])).unwrap();
    let known = KnownServers::load(dir.path()).unwrap();
    assert!(matches!(known.expected(odd, at("10.0.0.1:1")), ExpectedIdentity::Pinned { .. }));
    assert!(matches!(known.expected("other:1", address), ExpectedIdentity::Pinned { .. }));
}

#[test]
fn a_damaged_list_is_named_with_the_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let bad_address = format!("\"a:1\" = {{ fingerprint = \"{}\", last_address = \"x\" }}", fingerprint(1));
    for content in ["\"a:1\" = \"12ab\"", "\"a:1\" = 3", "what is this", &bad_address] {
        fs::write(dir.path().join(KNOWN_SERVERS_FILE), content).unwrap();
        let message = KnownServers::load(dir.path()).unwrap_err().to_string();
        assert!(message.contains(KNOWN_SERVERS_FILE) && message.contains("delete it"), "{message}");
    }
}

#[test]
fn a_fingerprint_reads_back_as_it_is_written() {
    let fingerprint = Fingerprint(rng::bytes32(5, 5));
    assert_eq!(fingerprint.to_string().parse(), Ok(fingerprint));
    assert!("é".repeat(32).parse::<Fingerprint>().is_err());
}
