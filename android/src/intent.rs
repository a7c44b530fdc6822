//! The extras of the intent that started the activity. This module only asks Java for them; [`crate::settings`] interprets
//! them.

use crate::settings::Key;
use android_activity::AndroidApp;
use jni::objects::{JObject, JString};
use jni::{Env, JValue, JavaVM, jni_sig, jni_str};

/// Those that are settings, as text; `adb shell am start --es`, `--ef` and `--ei` give them as different types.
pub fn extras(app: &AndroidApp) -> Vec<(Key, String)> {
    // SAFETY: the pointer is the process's JavaVM, which never goes away.
    let machine = unsafe { JavaVM::from_raw(app.vm_as_ptr().cast()) };
    machine.attach_current_thread(|env| read(env, app)).unwrap_or_else(|error| {
        tracing::warn!("the intent's extras could not be read: {error}; settings are those of the file");
        Vec::new()
    })
}

fn read(env: &mut Env<'_>, app: &AndroidApp) -> jni::errors::Result<Vec<(Key, String)>> {
    let activity = app.activity_as_ptr().cast();
    // SAFETY: a global reference to the NativeActivity, valid until the last `AndroidApp` is dropped.
    let activity = unsafe { env.as_cast_raw::<JObject<'_>>(&activity)? };
    let to_intent = jni_sig!(() -> android.content.Intent);
    let intent = env.call_method(&*activity, jni_str!("getIntent"), to_intent, &[])?.l()?;
    let to_bundle = jni_sig!(() -> android.os.Bundle);
    let bundle = env.call_method(&intent, jni_str!("getExtras"), to_bundle, &[])?.l()?;
    let mut extras = Vec::new();
    if bundle.is_null() {
        return Ok(extras);
    }
    for key in Key::ALL {
        let name = env.new_string(key.name())?;
        let to_value = jni_sig!((java.lang.String) -> java.lang.Object);
        let value = env.call_method(&bundle, jni_str!("get"), to_value, &[JValue::Object(&name)])?.l()?;
        if value.is_null() {
            continue;
        }
        let to_text = jni_sig!(() -> java.lang.String);
        let text = env.call_method(&value, jni_str!("toString"), to_text, &[])?.l()?;
        extras.push((key, env.cast_local::<JString<'_>>(text)?.try_to_string(env)?));
    }
    Ok(extras)
}
