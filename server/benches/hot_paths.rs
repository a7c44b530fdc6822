//! What placement costs an update on the CPU, beside its floor: `cargo bench -p shadecast-server --features bench`.
//!
//! A scene of 46,656 patches of which a half is in view; with each update a hundredth of all comes into view, and as many leave it.

use divan::Bencher;
use divan::counter::ItemsCount;
use shadecast_server::bench::{PATCHES, Placing};

fn main() {
    divan::main();
}

/// Sizes and places of blocks. What the views show is made before, and not counted.
#[divan::bench]
fn layout(bencher: Bencher) {
    let placing = std::cell::RefCell::new(Placing::settled());
    let see = || {
        let mut placing = placing.borrow_mut();
        placing.see();
    };
    let bencher = bencher.counter(ItemsCount::new(PATCHES / 2));
    bencher.with_inputs(see).bench_local_values(|()| placing.borrow_mut().lay_out());
}

/// Slots of what changed, and its bytes.
#[divan::bench]
fn residency(bencher: Bencher) {
    let placing = std::cell::RefCell::new(Placing::settled());
    let lay_out = || {
        let mut placing = placing.borrow_mut();
        placing.see();
        placing.lay_out()
    };
    bencher
        .with_inputs(lay_out)
        .input_counter(|changes| ItemsCount::new(*changes))
        .bench_local_values(|_| placing.borrow_mut().tell());
}

#[divan::bench]
fn layout_floor(bencher: Bencher) {
    let placing = Placing::settled();
    bencher.counter(ItemsCount::new(PATCHES / 2)).bench_local(|| placing.floor());
}
