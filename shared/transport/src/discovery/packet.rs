//! The question and the content of its answers. Pure: bytes in and out.

use super::{FINGERPRINT_KEY, SERVICE};
use crate::identity::Fingerprint;
use shadecast_protocol::text::printable;
use simple_dns::rdata::RData;
use simple_dns::{CLASS, Name, Packet, QCLASS, QTYPE, Question, ResourceRecord, TYPE};
use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};

/// Servers of one answer that are looked at; a liar's long list is cut.
const MAX_SERVERS: usize = 16;
/// Addresses of a server that are looked at, of one answer and of all of a search.
pub(super) const MAX_ADDRESSES: usize = 8;

/// A server that has announced itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundServer {
    /// Its name for people, printable.
    pub name: String,
    /// Where it listens, in the answer's order.
    pub addresses: Vec<SocketAddr>,
    /// The key that it says is its own.
    pub fingerprint: Option<Fingerprint>,
}

impl FoundServer {
    /// Whether both are one server, as far as they say: addresses come and go with the networks that were heard.
    pub fn is_same(&self, other: &Self) -> bool {
        self.name == other.name && self.fingerprint == other.fingerprint
    }
}

/// The question of number `id` for all servers, answered to whoever asks.
pub fn question(id: u16) -> Vec<u8> {
    let name = format!("{SERVICE}.local");
    let name = Name::new(&name).expect("a name of three labels");
    let mut packet = Packet::new_query(id);
    packet.questions.push(Question::new(name, QTYPE::TYPE(TYPE::PTR), QCLASS::CLASS(CLASS::IN), true));
    packet.build_bytes_vec().expect("one question")
}

/// The servers that a datagram names, if it is an answer to question `id`, or to none in particular (0).
pub fn servers(datagram: &[u8], id: u16) -> Vec<FoundServer> {
    let Ok(packet) = Packet::parse(datagram) else { return Vec::new() };
    let is_answer = packet.has_flags(simple_dns::PacketFlag::RESPONSE);
    if !is_answer || ![0, id].contains(&packet.id()) {
        return Vec::new();
    }
    let records: Vec<&ResourceRecord<'_>> = packet.answers.iter().chain(&packet.additional_records).collect();
    let mut hosts: BTreeMap<String, Vec<IpAddr>> = BTreeMap::new();
    for record in &records {
        let address = match &record.rdata {
            RData::A(a) => IpAddr::from(a.address.to_be_bytes()),
            RData::AAAA(aaaa) => IpAddr::from(aaaa.address.to_be_bytes()),
            _ => continue,
        };
        let of_host = hosts.entry(record.name.to_string().to_ascii_lowercase()).or_default();
        if of_host.len() < MAX_ADDRESSES && is_usable(address) && !of_host.contains(&address) {
            of_host.push(address);
        }
    }
    let mut found = Vec::new();
    for record in &records {
        let RData::SRV(service) = &record.rdata else { continue };
        let instance = record.name.to_string();
        let Some(name) = instance_name(&instance).filter(|_| found.len() < MAX_SERVERS) else { continue };
        let host = service.target.to_string().to_ascii_lowercase();
        let addresses: Vec<SocketAddr> =
            hosts.get(&host).into_iter().flatten().map(|ip| (*ip, service.port).into()).collect();
        if !addresses.is_empty() && service.port != 0 {
            found.push(FoundServer { name, addresses, fingerprint: fingerprint(&records, &instance) });
        }
    }
    found
}

/// Addresses that need no interface beside them.
fn is_usable(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => !v4.is_unspecified() && !v4.is_multicast() && !v4.is_broadcast(),
        IpAddr::V6(v6) => !v6.is_unspecified() && !v6.is_multicast() && !v6.is_unicast_link_local(),
    }
}

/// `living room._shadecast._udp.local` without the service.
fn instance_name(instance: &str) -> Option<String> {
    let of_service = format!(".{SERVICE}.local");
    let lower = instance.to_ascii_lowercase();
    let name = lower.strip_suffix(&of_service).map(|name| &instance[..name.len()])?;
    (!name.is_empty()).then(|| printable(name))
}

fn fingerprint(records: &[&ResourceRecord<'_>], instance: &str) -> Option<Fingerprint> {
    let of_instance = records.iter().filter(|record| record.name.to_string().eq_ignore_ascii_case(instance));
    let mut texts = of_instance.filter_map(|record| match &record.rdata {
        RData::TXT(text) => text.attributes().get(FINGERPRINT_KEY).cloned().flatten(),
        _ => None,
    });
    texts.next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use simple_dns::rdata::{A, PTR, SRV, TXT};

    const ID: u16 = 77;

    fn record<'a>(name: &'a str, rdata: RData<'a>) -> ResourceRecord<'a> {
        ResourceRecord::new(Name::new(name).expect("a name"), CLASS::IN, 10, rdata)
    }

    /// An answer as a server gives it, with `host` at `ip`.
    fn answer(id: u16, instance: &str, host: &str, ip: [u8; 4], text: &str) -> Vec<u8> {
        let service = format!("{SERVICE}.local");
        let full = format!("{instance}.{service}");
        let mut packet = Packet::new_reply(id);
        let name = |text: &str| Name::new(text).expect("a name").into_owned();
        packet.answers.push(record(&service, RData::PTR(PTR(name(&full)))));
        packet
            .additional_records
            .push(record(&full, RData::SRV(SRV { priority: 0, weight: 0, port: 7400, target: name(host) })));
        let text = TXT::new().with_string(text).expect("a short text");
        packet.additional_records.push(record(&full, RData::TXT(text)));
        packet.additional_records.push(record(host, RData::A(A { address: u32::from_be_bytes(ip) })));
        packet.build_bytes_vec_compressed().expect("a packet")
    }

    #[test]
    fn an_answer_gives_name_address_and_fingerprint() {
        let key = "ab".repeat(32);
        let bytes = answer(ID, "desk", "desk.local", [192, 168, 1, 5], &format!("id={key}"));
        let found = servers(&bytes, ID);
        let expected = FoundServer {
            name: "desk".into(),
            addresses: vec!["192.168.1.5:7400".parse().expect("an address")],
            fingerprint: key.parse().ok(),
        };
        assert!(expected.fingerprint.is_some());
        assert_eq!(found, [expected]);
    }

    #[test]
    fn what_is_no_answer_of_ours_names_nobody() {
        let bytes = answer(ID, "desk", "desk.local", [192, 168, 1, 5], "id=x");
        assert_eq!(servers(&bytes, ID)[0].fingerprint, None, "a fingerprint that is none");
        assert_eq!(servers(&bytes, ID + 1), [], "an answer to somebody else");
        assert_eq!(servers(&question(ID), ID), [], "a question");
        for ip in [[0, 0, 0, 0], [224, 0, 0, 251], [255, 255, 255, 255]] {
            assert_eq!(servers(&answer(ID, "desk", "desk.local", ip, "id=x"), ID), [], "{ip:?}");
        }
        for cut in 0..bytes.len() {
            servers(&bytes[..cut], ID);
        }
        for at in 0..bytes.len() {
            for value in [0, 0x3f, 0xc0, 0xff] {
                let mut bent = bytes.clone();
                bent[at] = value;
                servers(&bent, ID);
            }
        }
    }

    #[test]
    fn a_name_is_fit_to_be_printed() {
        let bytes = answer(ID, "de\u{1b}[31msk", "desk.local", [192, 168, 1, 5], "id=x");
        let found = servers(&bytes, ID);
        assert!(found.iter().all(|server| !server.name.contains('\u{1b}')), "{found:?}");
    }
}
