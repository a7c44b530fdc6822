use super::*;
use serde::Deserialize;
use std::cell::Cell;
use std::convert::Infallible;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Thing {
    name: String,
    #[serde(with = "crate::bulk")]
    numbers: Vec<u32>,
}

fn thing(number: u32) -> Thing {
    Thing { name: "thing".into(), numbers: (0..1000).map(|i| i ^ number).collect() }
}

/// The result, and whether it had to be computed.
fn ask(cache: &Cache, key: &Key, number: u32) -> (Thing, bool) {
    let computed = Cell::new(false);
    let compute = || {
        computed.set(true);
        Ok::<_, Infallible>(thing(number))
    };
    let Ok(value) = cache.try_get_or_compute(key, |_| Ok(()), compute);
    (value, computed.get())
}

fn only_file(folder: &Path) -> PathBuf {
    let files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|item| item.unwrap().path()).collect();
    let [file] = &files[..] else { panic!("one file expected: {files:?}") };
    file.clone()
}

fn set_age(path: &Path, age: Duration) {
    let file = std::fs::File::options().append(true).open(path).unwrap();
    file.set_modified(SystemTime::now() - age).unwrap();
}

#[test]
fn the_second_time_it_is_found_by_a_later_process_too() {
    let folder = tempfile::tempdir().unwrap();
    let key = || Key::new("thing", 1).bytes(b"input").value(&(0.5f32, "option"));
    let first = Cache::new(folder.path());
    assert_eq!(ask(&first, &key(), 1), (thing(1), true));
    assert_eq!(ask(&first, &key(), 2), (thing(1), false));
    assert_eq!(ask(&Cache::new(folder.path()), &key(), 3), (thing(1), false));
    assert_eq!(first.hits_and_misses(), (1, 1));
}

#[test]
fn whatever_differs_in_the_key_misses() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::new(folder.path());
    let keys = [
        Key::new("thing", 1).bytes(b"ab").bytes(b"c").value(&0.5f32),
        Key::new("other", 1).bytes(b"ab").bytes(b"c").value(&0.5f32),
        Key::new("thing", 2).bytes(b"ab").bytes(b"c").value(&0.5f32),
        Key::new("thing", 1).bytes(b"a").bytes(b"bc").value(&0.5f32),
        Key::new("thing", 1).bytes(b"ab").bytes(b"c").value(&0.25f32),
    ];
    for (number, key) in keys.iter().enumerate() {
        assert!(ask(&cache, key, number as u32).1, "key {number}");
    }
    for (number, key) in keys.iter().enumerate() {
        assert_eq!(ask(&cache, key, 99), (thing(number as u32), false));
    }
}

#[test]
fn every_damage_is_noticed_and_mended() {
    let folder = tempfile::tempdir().unwrap();
    let (cache, key) = (Cache::new(folder.path()), Key::new("thing", 1));
    ask(&cache, &key, 1);
    let file = only_file(folder.path());
    let whole = std::fs::read(&file).unwrap();
    let cuts = (0..whole.len()).step_by(97).map(|length| whole[..length].to_vec());
    let flips = (0..whole.len()).step_by(89).map(|at| {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x10;
        bytes
    });
    let longer = std::iter::once([&whole[..], b"!"].concat());
    for damaged in cuts.chain(flips).chain(longer) {
        std::fs::write(&file, damaged).unwrap();
        assert_eq!(ask(&cache, &key, 1), (thing(1), true));
        assert_eq!(std::fs::read(&file).unwrap(), whole, "mended");
    }
}

#[test]
fn an_entry_that_fails_its_check_is_made_anew() {
    let folder = tempfile::tempdir().unwrap();
    let (cache, key) = (Cache::new(folder.path()), Key::new("thing", 1));
    ask(&cache, &key, 1);
    let check = |thing: &Thing| if thing.numbers[0] == 1 { Err("one") } else { Ok(()) };
    let Ok(second) = cache.try_get_or_compute(&key, check, || Ok::<_, Infallible>(thing(2)));
    assert_eq!(second, thing(2));
    assert_eq!(ask(&cache, &key, 3), (thing(2), false), "it was kept");
}

#[test]
fn folder_and_entries_are_their_owners_alone() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("a/b");
    ask(&Cache::new(&inner), &Key::new("thing", 1), 1);
    for path in [&inner, &only_file(&inner)] {
        assert_eq!(owner::open_to_others(&std::fs::metadata(path).unwrap()), None, "{}", path.display());
    }
}

#[cfg(unix)]
#[test]
fn a_folder_that_others_can_write_to_is_not_used() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let key = Key::new("thing", 1);
    ask(&Cache::new(folder.path()), &key, 1);
    for others in [0o777, 0o770, 0o702] {
        std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(others)).unwrap();
        let cache = Cache::new(folder.path());
        assert!(cache.folder().is_none(), "mode {others:o}");
        assert_eq!(ask(&cache, &key, 2), (thing(2), true), "mode {others:o}");
    }
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    assert_eq!(ask(&Cache::new(folder.path()), &key, 3), (thing(1), false));
}

#[test]
fn a_pipe_in_the_place_of_an_entry_is_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let key = Key::new("thing", 1);
    let pipe = folder.path().join(key.file_name());
    assert!(std::process::Command::new("mkfifo").arg(pipe).status().unwrap().success());
    assert_eq!(ask(&Cache::new(folder.path()), &key, 1), (thing(1), true));
}

#[test]
fn an_entry_under_a_wrong_name_or_of_a_wrong_type_is_not_taken() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::new(folder.path());
    ask(&cache, &Key::new("thing", 1), 1);
    let other = Key::new("thing", 2);
    std::fs::rename(only_file(folder.path()), folder.path().join(other.file_name())).unwrap();
    assert_eq!(ask(&cache, &other, 2), (thing(2), true));
    cache.keep(&Key::new("thing", 3), &7u8);
    assert_eq!(ask(&cache, &Key::new("thing", 3), 3), (thing(3), true));
}

#[test]
fn an_error_is_handed_on_and_not_kept() {
    let folder = tempfile::tempdir().unwrap();
    let (cache, key) = (Cache::new(folder.path()), Key::new("thing", 1));
    assert_eq!(cache.try_get_or_compute::<Thing, _>(&key, |_| Ok(()), || Err("no")), Err("no"));
    assert!(ask(&cache, &key, 1).1);
}

#[test]
fn the_least_recently_used_entries_make_room() {
    let folder = tempfile::tempdir().unwrap();
    let size = 4200;
    let cache = Cache::with(Some(folder.path().to_owned()), 3 * size);
    let key = |number: u32| Key::new("thing", number);
    for number in 0..3 {
        ask(&cache, &key(number), number);
        let age = Duration::from_secs(u64::from(100 - number));
        let path = folder.path().join(key(number).file_name());
        assert!(std::fs::metadata(&path).unwrap().len() < size);
        set_age(&path, age);
    }
    assert!(!ask(&cache, &key(0), 0).1, "now 1 is the one not used for longest");
    ask(&cache, &key(3), 3);
    let is_there = |number: u32| folder.path().join(key(number).file_name()).exists();
    assert_eq!([0, 1, 2, 3].map(is_there), [true, false, true, true]);
}

#[test]
fn leftovers_of_dead_writers_go_and_strange_files_stay() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::new(folder.path());
    let (dead, alive, strange) =
        ["thing.1-0.new", "thing.2-0.new", "letter.txt"].map(|name| folder.path().join(name)).into();
    for path in [&dead, &alive, &strange] {
        std::fs::write(path, b"x").unwrap();
    }
    for path in [&dead, &strange] {
        set_age(path, 2 * ABANDONED_AFTER);
    }
    ask(&cache, &Key::new("thing", 1), 1);
    assert_eq!([dead, alive, strange].map(|path| path.exists()), [false, true, true]);
}

#[test]
fn many_writers_and_readers_at_once_see_whole_entries_only() {
    let folder = tempfile::tempdir().unwrap();
    let work = || {
        // A cache of its own each, as processes have.
        for round in 0..40 {
            let cache = Cache::new(folder.path());
            let number = round % 4;
            assert_eq!(ask(&cache, &Key::new("thing", number), number).0, thing(number));
            if round % 8 == 7 {
                let _ = std::fs::remove_file(folder.path().join(Key::new("thing", number).file_name()));
            }
        }
    };
    std::thread::scope(|scope| (0..4).for_each(|_| drop(scope.spawn(work))));
    let names = std::fs::read_dir(folder.path()).unwrap().map(|item| item.unwrap().file_name());
    assert!(names.into_iter().all(|name| name.to_string_lossy().ends_with(".entry")));
}

#[test]
fn a_folder_that_cannot_be_made_only_costs_time() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, b"in the way").unwrap();
    let cache = Cache::new(file.join("cache"));
    assert_eq!(ask(&cache, &Key::new("thing", 1), 1), (thing(1), true));
    assert_eq!(ask(&cache, &Key::new("thing", 1), 1), (thing(1), true));
    assert!(ask(&Cache::disabled(), &Key::new("thing", 1), 1).1);
}
