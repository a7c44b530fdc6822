//! Messages and datagrams of both sides, and the heads of streams: what can be read can be written and read again.

use crate::script::steps;
use shadecast_protocol::message::{ClientDatagram, ClientMessage, ServerDatagram, ServerMessage};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::motion::poses::GridPose;
use shadecast_protocol::wire::{StreamMessage, encode_geometry, encode_motion, encode_picture, parse_stream};

/// A client's control message.
pub const CLIENT_MESSAGE: u8 = 0;
/// A server's control message.
pub const SERVER_MESSAGE: u8 = 1;
/// A client's datagram.
pub const CLIENT_DATAGRAM: u8 = 2;
/// A server's datagram.
pub const SERVER_DATAGRAM: u8 = 3;
/// A unidirectional stream of the server.
pub const STREAM: u8 = 4;

/// The number of steps that could be read.
pub fn check(script: &[u8]) -> usize {
    steps(script).filter(|step| read(step.operation, step.bytes)).count()
}

fn read(operation: u8, bytes: &[u8]) -> bool {
    match operation {
        CLIENT_MESSAGE => {
            // Read from any bytes, whether they are a hello or not.
            ClientMessage::peek_versions(bytes);
            let Ok(message) = ClientMessage::decode(bytes) else { return false };
            assert_eq!(ClientMessage::decode(&message.encode()), Ok(message));
        }
        SERVER_MESSAGE => {
            let Ok(message) = ServerMessage::decode(bytes) else { return false };
            assert_eq!(ServerMessage::decode(&message.encode()), Ok(message));
        }
        CLIENT_DATAGRAM => {
            let Ok(datagram) = ClientDatagram::decode(bytes) else { return false };
            assert_eq!(ClientDatagram::decode(&datagram.encode()), Ok(datagram));
        }
        SERVER_DATAGRAM => {
            let Ok(datagram) = ServerDatagram::decode(bytes) else { return false };
            assert_eq!(ServerDatagram::decode(&datagram.encode()), Ok(datagram));
        }
        _ => {
            let Ok(message) = parse_stream(bytes) else { return false };
            let written = match message {
                StreamMessage::Motion(payload) => {
                    let Ok(message) = MotionMessage::decode(payload) else { return false };
                    let written = encode_motion(&message.encode());
                    let StreamMessage::Motion(again) = parse_stream(&written).expect("just written") else {
                        panic!("motion comes back as something else");
                    };
                    let again = MotionMessage::decode(again).expect("just written");
                    assert!(is_same(&message, &again), "{message:?}\n{again:?}");
                    return true;
                }
                StreamMessage::Geometry { payload, .. } => encode_geometry(payload),
                StreamMessage::Picture { header, access_unit } => encode_picture(header, access_unit),
            };
            assert_eq!(parse_stream(&written), Ok(message));
        }
    }
    true
}

/// Rotations of poses travel as their three smallest numbers, rounded: what was read from any bytes may come back a step away, and
/// as the same rotation with the other sign.
fn is_same(read: &MotionMessage, again: &MotionMessage) -> bool {
    let (MotionNews::Poses(before), MotionNews::Poses(after)) = (&read.news, &again.news) else {
        return read == again;
    };
    let rotations = |poses: &[GridPose]| -> Vec<[f32; 4]> {
        poses.iter().flat_map(|pose| &pose.bones).map(|bone| bone.rotation).collect()
    };
    let others = |poses: &[GridPose]| -> Vec<GridPose> {
        let mut poses = poses.to_vec();
        poses.iter_mut().flat_map(|pose| &mut pose.bones).for_each(|bone| bone.rotation = [0.0; 4]);
        poses
    };
    let is_close =
        |(a, b): (&[f32; 4], &[f32; 4])| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>().abs() > 0.999;
    read.sequence == again.sequence
        && others(before) == others(after)
        && rotations(before).iter().zip(&rotations(after)).all(is_close)
}
