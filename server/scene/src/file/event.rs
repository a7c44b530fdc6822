//! Events of a scene file over time: `[[event]]`s, which change an instance's playback.

use super::fields::Fields;
use super::path::REPETITIONS;
use super::{ClipChoice, EventEntry, InstanceEntry};
use crate::SceneError;
use crate::limits::{MAX_DURATION_S, MAX_EVENTS, MAX_FADE_S};
use crate::suggest::did_you_mean_or_list;
use crate::timeline::Change;
use shadecast_model::text::printable;
use shadecast_model::time::WorldTime;

const CHANGE_KEYS: [&str; 6] = ["clip", "speed", "pause", "seek", "repetition", "fade"];
/// An event of time 0 would be what the instance itself says.
const FIRST_S: f32 = 0.001;

/// All `[[event]]`, in order of their times.
pub(super) fn read_events(root: &Fields, instances: &[InstanceEntry]) -> Result<Vec<EventEntry>, SceneError> {
    let known = [&["at", "instance"][..], &CHANGE_KEYS].concat();
    let tables = root.tables("event", &known)?;
    if let Some(fields) = tables.get(MAX_EVENTS) {
        let problem = format!("a scene can have at most {MAX_EVENTS} events");
        return Err(fields.source.error(fields.line, problem));
    }
    let mut events = Vec::new();
    for fields in &tables {
        let event = read_event(fields, instances)?;
        events.push((event, fields));
    }
    events.sort_by_key(|(event, _)| event.at);
    check_fades(&events)?;
    Ok(events.into_iter().map(|(event, _)| event).collect())
}

fn read_event(fields: &Fields, instances: &[InstanceEntry]) -> Result<EventEntry, SceneError> {
    let at_ns = fields.required("at", fields.nanoseconds("at", FIRST_S..=MAX_DURATION_S)?)?;
    let instance = read_instance(fields, instances)?;
    if fields.first_of(&CHANGE_KEYS[..5]).is_none() {
        let problem = format!("event changes nothing; give it {}", CHANGE_KEYS[..5].join(", "));
        return Err(fields.source.error(fields.line, problem));
    }
    Ok(EventEntry {
        at: WorldTime(at_ns),
        instance,
        clip: ClipChoice::read(fields)?,
        change: Change {
            clip: None,
            local_s: fields.number("seek")?.map(f64::from),
            speed: read_speed(fields)?,
            repetition: fields.choice("repetition", &REPETITIONS)?,
            fade_ns: fields.nanoseconds("fade", 0.0..=MAX_FADE_S)?.unwrap_or(0),
        },
    })
}

fn read_instance(fields: &Fields, instances: &[InstanceEntry]) -> Result<usize, SceneError> {
    let (wanted, line) = fields.required_string("instance")?;
    let names = instances.iter().map(|instance| instance.name.as_str());
    let mut found = names.clone().enumerate().filter(|(_, name)| *name == wanted).map(|(index, _)| index);
    let fault = |problem: String| Err(fields.source.error(line, problem));
    match (found.next(), found.next()) {
        (Some(index), None) => Ok(index),
        (Some(_), Some(_)) => {
            fault(format!("several instances have the name \"{}\"; give each its own", printable(&wanted)))
        }
        (None, _) => {
            let hint = did_you_mean_or_list(&wanted, names, "there is");
            fault(format!("instance \"{}\" is not defined{hint}", printable(&wanted)))
        }
    }
}

fn read_speed(fields: &Fields) -> Result<Option<f64>, SceneError> {
    fields.only_one_of(&["speed", "pause"])?;
    match fields.flag("pause")? {
        Some(true) => Ok(Some(0.0)),
        Some(false) => Err(fields.error("pause", "\"pause\" can only be true; to go on, give \"speed\"")),
        None => Ok(fields.number("speed")?.map(f64::from)),
    }
}

/// No event of an instance falls into the fade of the one before: three clips would be seen at once.
fn check_fades(events: &[(EventEntry, &Fields)]) -> Result<(), SceneError> {
    for (index, (event, fields)) in events.iter().enumerate() {
        let mut own = events[..index].iter().filter(|(earlier, _)| earlier.instance == event.instance);
        let Some((before, _)) = own.next_back() else { continue };
        let free = before.at.plus_ns(before.change.fade_ns.max(1));
        if event.at < free {
            let [at_s, before_s, end_s] = [event.at, before.at, free].map(WorldTime::seconds);
            let problem = format!(
                "at {at_s:.3} s the instance's event of {before_s:.3} s is not over before {end_s:.3} s; put \
                 this one there or later, or shorten the fade of that one"
            );
            return Err(fields.error("at", problem));
        }
    }
    Ok(())
}
