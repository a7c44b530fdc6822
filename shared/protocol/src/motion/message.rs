//! Messages about motion, each on its own stream: they wait for no update, and none waits for another.

use super::clip::ClipChunk;
use super::playback::Schedule;
use super::poses::{GridPose, put_poses, take_poses};
use super::skeleton::{ClipRef, check_schedule};
use crate::ids::InstanceId;
use crate::limits::MAX_INSTANCES;
use crate::wire::{Reader, WireError, check_count, invalid};
use crate::world_clock::WorldClock;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

const TAG_CHUNK: u8 = 1;
const TAG_SCHEDULE: u8 = 2;
const TAG_POSES: u8 = 3;
const TAG_CLOCK: u8 = 4;

/// One of them.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionMessage {
    /// Rises by one a message. Of two that write the same words of the arena, the later one counts, whichever comes first; so it
    /// is with schedules of an instance.
    pub sequence: u32,
    /// What it says.
    pub news: MotionNews,
}

/// What a message about motion says.
#[derive(Clone, Debug, PartialEq)]
pub enum MotionNews {
    /// A clip between two times. What lay in the arena in its place is forgotten.
    Chunk(ClipChunk),
    /// What an instance plays from now on.
    Schedule(NewSchedule),
    /// Poses on the time grid. The instance's ring holds them from then on, whichever message comes first.
    Poses(Vec<GridPose>),
    /// How the world's time follows the server's clock from now on.
    Clock(Box<WorldClock>),
}

/// What an instance plays from now on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NewSchedule {
    /// The instance.
    pub instance: InstanceId,
    /// Its clips.
    pub schedule: Schedule<ClipRef>,
}

impl MotionMessage {
    /// For [`Self::decode`].
    pub fn encode(&self) -> Vec<u8> {
        let mut out = self.sequence.to_le_bytes().to_vec();
        match &self.news {
            MotionNews::Chunk(chunk) => {
                out.push(TAG_CHUNK);
                chunk.put(&mut out);
            }
            MotionNews::Schedule(change) => {
                out.push(TAG_SCHEDULE);
                // Fails only for types that cannot be serialised at all, which ours are not.
                out.extend(postcard::to_stdvec(change).expect("plain messages serialise"));
            }
            MotionNews::Clock(clock) => {
                out.push(TAG_CLOCK);
                out.extend(postcard::to_stdvec(&**clock).expect("plain messages serialise"));
            }
            MotionNews::Poses(poses) => {
                out.push(TAG_POSES);
                put_poses(&mut out, poses);
            }
        }
        out
    }

    /// The message of these bytes.
    ///
    /// # Errors
    /// The bytes are none.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let mut reader = Reader::new("a message about motion", bytes);
        let sequence = reader.u32()?;
        let news = match reader.u8()? {
            TAG_CHUNK => MotionNews::Chunk(ClipChunk::take(&mut reader)?),
            TAG_SCHEDULE => MotionNews::Schedule(NewSchedule::take(&mut reader)?),
            TAG_POSES => MotionNews::Poses(take_poses(reader.rest())?),
            TAG_CLOCK => MotionNews::Clock(Box::new(take_clock(&mut reader)?)),
            other => return Err(invalid("a message about motion", format!("its kind {other} is none"))),
        };
        reader.finish()?;
        Ok(Self { sequence, news })
    }
}

/// All that is left of a message.
fn take_whole<T: DeserializeOwned>(what: &'static str, reader: &mut Reader<'_>) -> Result<T, WireError> {
    let (whole, rest) =
        postcard::take_from_bytes(reader.rest()).map_err(|error| invalid(what, error.to_string()))?;
    if rest.is_empty() { Ok(whole) } else { Err(WireError::Trailing { what, left: rest.len() }) }
}

fn take_clock(reader: &mut Reader<'_>) -> Result<WorldClock, WireError> {
    let clock: WorldClock = take_whole("the world's clock", reader)?;
    clock.check().map(|()| clock)
}

impl NewSchedule {
    fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let change: Self = take_whole("a schedule of clips", reader)?;
        check_schedule(&change.schedule)?;
        let number = usize::from(change.instance.0);
        check_count("the number of an instance", number, MAX_INSTANCES as usize - 1)?;
        Ok(change)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::ClipId;
    use crate::motion::playback::{Playback, Repetition};
    use crate::motion::poses::BonePose;
    use crate::testing::damaged;
    use crate::time::{GridIndex, ServerTime, WorldTime};
    use crate::world_clock::Steer;

    fn message() -> MotionMessage {
        let playback = |from, clip| Playback {
            from: WorldTime(from),
            clip: ClipRef { clip: ClipId(clip), duration_s: 4.0 },
            start_s: 0.25,
            speed: -1.5,
            repetition: Repetition::PingPong,
            fade_ns: 300_000_000,
        };
        let mut schedule = Schedule::new(playback(0, 3));
        schedule.change(playback(7_000_000_000, 4));
        let news = MotionNews::Schedule(NewSchedule { instance: InstanceId(12), schedule });
        MotionMessage { sequence: 9, news }
    }

    #[test]
    fn schedules_come_back_as_they_were() {
        assert_eq!(MotionMessage::decode(&message().encode()), Ok(message()));
    }

    #[test]
    fn poses_come_back_with_their_message() {
        let bone =
            BonePose { translation: [0.5, 0.0, -1.0], rotation: [0.0, 0.0, 0.0, 1.0], scale: [2.0; 3] };
        let pose = |grid| GridPose {
            instance: InstanceId(12),
            grid: GridIndex(grid),
            bones: vec![bone; 3],
            weights: vec![0.5],
        };
        let news = MotionNews::Poses(vec![pose(40), pose(41)]);
        let message = MotionMessage { sequence: 10, news };
        assert_eq!(MotionMessage::decode(&message.encode()), Ok(message));
    }

    /// A world that stands, after two that have gone on.
    fn clock() -> MotionMessage {
        let mut clock = WorldClock::default();
        for (steer, at_ns) in [(Steer::Halt, 5), (Steer::Step, 900_000_000), (Steer::Step, 2_000_000_000)] {
            clock.steer(steer, ServerTime(at_ns));
        }
        MotionMessage { sequence: 11, news: MotionNews::Clock(Box::new(clock)) }
    }

    #[test]
    fn the_worlds_clock_comes_back_as_it_was() {
        assert_eq!(MotionMessage::decode(&clock().encode()), Ok(clock()));
    }

    #[test]
    fn damaged_messages_give_values_or_errors() {
        for bytes in [message(), clock()].map(|message| message.encode()) {
            damaged(&bytes, 5, 5000, |bytes| drop(MotionMessage::decode(bytes)));
            (0..bytes.len()).for_each(|length| assert!(MotionMessage::decode(&bytes[..length]).is_err()));
            assert!(MotionMessage::decode(&[&bytes[..], &[0]].concat()).is_err(), "one byte more");
        }
    }

    #[test]
    fn schedules_that_cannot_be_evaluated_are_refused() {
        let MotionNews::Schedule(change) = message().news else { unreachable!() };
        let of = |entries: Vec<Playback<ClipRef>>| {
            // As its bytes: a list of entries.
            let mut bytes = 9u32.to_le_bytes().to_vec();
            bytes.push(TAG_SCHEDULE);
            bytes.extend(postcard::to_stdvec(&(change.instance, entries)).unwrap());
            MotionMessage::decode(&bytes)
        };
        let good = change.schedule.entries().to_vec();
        assert!(of(good.clone()).is_ok());
        assert!(of(Vec::new()).is_err(), "empty");
        assert!(of(good.iter().rev().copied().collect()).is_err(), "times do not rise");
        let spoiled = |spoil: fn(&mut Playback<ClipRef>)| {
            let mut entries = good.clone();
            spoil(&mut entries[1]);
            of(entries)
        };
        assert!(spoiled(|entry| entry.speed = f64::NAN).is_err());
        assert!(spoiled(|entry| entry.clip.duration_s = -1.0).is_err());
        assert!(spoiled(|entry| entry.fade_ns = -1).is_err());
    }
}
